"""One robot's pictures and sound as a film, or its sound alone: each at the time at which it was received."""

import heapq
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from pebble.contract import OUTGOING
from pebble.contract.packets import PBAT
from pebble.errors import PebbleError
from pebble.media import pyav
from pebble.recordings.exports.film_pictures import MILLISECOND, PictureTrack
from pebble.recordings.exports.film_sound import RATE, SoundResult, SoundTrack
from pebble.recordings.exports.lines import Progress
from pebble.recordings.exports.unfinished import unfinished
from pebble.recordings.files.recorded import Recorded, RecordingError
from pebble.recordings.stamps import is_picture

#: By the ending of the film: FFmpeg's names of the container and of the encoder of its sound.
_FORMATS: Final = {".mkv": ("matroska", "libopus"), ".mp4": ("mp4", "aac")}
_PYAV: Final = 15  # older ones cannot make a stream out of packets that another encoder made
_BITRATE: Final = 64_000  # bits per second of each channel
_LAST_PICTURE_MS: Final = 66  # how long a film of one picture is


@dataclass(frozen=True, slots=True)
class FilmResult:
    """What a film is made of."""

    seconds: float
    pictures: int
    left_out: int  # pictures: damaged, or without those that they build on
    width: int
    height: int
    scaled: int  # pictures of another size than the film
    sound: SoundResult | None  # None: none was received


def write_film(
    messages: Iterable[Recorded],
    target: Path,
    robot: str,
    *,
    overwrite: bool = False,
    on_time: Progress | None = None,
) -> FilmResult:
    """Write the pictures and the sound of ``robot`` (its base) to ``target``, which ends in .mkv or .mp4.

    If several of its topics carry pictures, or sound, the first one counts. The film has the size of its first
    picture. Raises RecordingError if there are no pictures or ``target`` cannot be written; PebbleError without PyAV.
    """
    if target.suffix not in _FORMATS:
        raise RecordingError(f"{target}: a film ends in {' or '.join(_FORMATS)}")
    av = _pyav()
    with unfinished(target, overwrite=overwrite) as path, _folder_beside(target) as folder:
        try:
            pictures = PictureTrack(av, folder / "pictures.mkv")
            with closing(pictures), SoundTrack(folder / "sound.wav") as sound:
                for at_ms, payload in _media(messages, robot, on_time):
                    (pictures if is_picture(payload) else sound).add(payload, at_ms)
            if pictures.count == 0:
                raise RecordingError(f"{robot}: no pictures; its sound alone can be exported as wav")
            _join(av, pictures.path, sound.path if sound.result.packets else None, path, target.suffix)
        except av.error.FFmpegError as error:
            raise RecordingError(f"{target}: {error}") from None
    return _result(pictures, sound.result if sound.result.packets else None)


def write_wav(
    messages: Iterable[Recorded], target: Path, robot: str, *, overwrite: bool = False, on_time: Progress | None = None
) -> SoundResult:
    """Write the sound of ``robot`` (its base) to ``target``, from its first sample on. Raises RecordingError."""
    with unfinished(target, overwrite=overwrite) as path, SoundTrack(path) as track:
        first_ms = None
        for at_ms, payload in _media(messages, robot, on_time):
            if not is_picture(payload):
                first_ms = at_ms if first_ms is None else first_ms
                track.add(payload, at_ms - first_ms)
        if not track.result.packets:
            raise RecordingError(f"{robot}: no sound" + ("" if pyav.installed() else f"; Opus {pyav.INSTALL}"))
    return track.result


def _result(pictures: PictureTrack, sound: SoundResult | None) -> FilmResult:
    seconds = max((pictures.last_ms + _LAST_PICTURE_MS) / 1000, 0.0 if sound is None else sound.seconds)
    return FilmResult(seconds, pictures.count, pictures.left_out, *pictures.size, pictures.scaled, sound)


def _pyav() -> Any:
    """Raises PebbleError."""
    av = pyav.load("film")
    if int(av.__version__.partition(".")[0]) < _PYAV:
        raise PebbleError(f"film needs PyAV {_PYAV} or newer, this is {av.__version__}")
    return av


@contextmanager
def _folder_beside(target: Path) -> Iterator[Path]:
    """A folder for files that may be as large as the film: one for temporary files is often in memory."""
    with tempfile.TemporaryDirectory(dir=target.parent, prefix=f".{target.name}.") as name:
        yield Path(name)


def _media(messages: Iterable[Recorded], robot: str, on_time: Progress | None) -> Iterator[tuple[int, bytes]]:
    """The pictures and the sound of one robot, of one topic each, with milliseconds since the first one."""
    below, topics, first_ms = f"{robot}/{OUTGOING}/", dict[bool, str](), None
    for message in messages:
        if on_time is not None:
            on_time(message.log_ns)
        topic, payload = message.channel.topic, message.payload
        if topic.startswith(below) and message.channel.metadata.get("retained") != "1":
            picture = is_picture(payload)
            if (picture or payload.startswith(PBAT)) and topics.setdefault(picture, topic) == topic:
                log_ms = message.log_ns // 10**6
                first_ms = log_ms if first_ms is None else first_ms
                yield log_ms - first_ms, payload


def _join(av: Any, pictures: Path, sound: Path | None, target: Path, ending: str) -> None:
    """One file of both, in the order of time."""
    container, codec = _FORMATS[ending]
    with av.open(str(target), "w", format=container) as out, av.open(str(pictures)) as source:
        stream = out.add_stream_from_template(source.streams.video[0], opaque=True)
        stream.time_base = MILLISECOND
        tracks = [_picture_packets(source, stream)]
        if sound is not None:
            tracks.append(_sound_packets(av, sound, out, codec))
        for packet in heapq.merge(*tracks, key=lambda packet: packet.dts * packet.time_base):
            out.mux(packet)


def _picture_packets(source: Any, stream: Any) -> Iterator[Any]:
    """Each is shown until the next one; the last one as long as the one before it."""
    duration = _LAST_PICTURE_MS
    packets = (packet for packet in source.demux(video=0) if packet.pts is not None)
    last = None
    for packet in packets:
        if last is not None:
            duration = last.duration = packet.pts - last.pts
            yield last
        packet.stream = stream
        last = packet
    if last is not None:
        last.duration = min(duration, 1000)
        yield last


def _sound_packets(av: Any, path: Path, out: Any, codec: str) -> Iterator[Any]:
    """Made while they are read, so that no more than a part of the sound is in memory."""
    with av.open(str(path), format="wav") as source:
        wav = source.streams.audio[0]
        layout = "mono" if wav.channels == 1 else "stereo"  # wav has no names for them
        stream = out.add_stream(codec, rate=RATE, layout=layout, bit_rate=_BITRATE * wav.channels)
        for frame in source.decode(wav):
            yield from stream.encode(frame)
        yield from stream.encode(None)
