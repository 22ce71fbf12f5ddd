"""A robot's pictures and sound as a film, or its sound alone, timed by their arrival at the recorder."""

import heapq
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any, Final

from pebble.contract import OUTGOING
from pebble.extensions.media import pyav
from pebble.extensions.recordings.exports.film_sound import RATE, SoundResult, SoundTrack
from pebble.extensions.recordings.exports.unfinished import unfinished
from pebble.extensions.recordings.files.recorded import Recorded, RecordingError
from pebble.extensions.recordings.library import reported
from pebble.extensions.recordings.stamps import is_media, is_picture

#: By the ending of the film: FFmpeg's names of the container and of the encoder of its sound.
_FORMATS: Final = {".mkv": ("matroska", "libopus"), ".mp4": ("mp4", "aac")}
_LAST_PICTURE_MS: Final = 66  # how long the last picture of a film is shown
_MILLISECOND: Final = Fraction(1, 1000)
_KEYFRAME_INTERVAL: Final = 60  # pictures: how far a player jumps
_NOMINAL_FPS: Final = 15  # for the encoder; each picture has its own time
_OPTIONS: Final = {"crf": "23", "preset": "veryfast"}
_MUXER: Final = {"mp4": {"movflags": "+faststart"}}  # its index comes first, so that a browser plays it while it loads
_BITRATE: Final = 64_000  # bits per second of each channel


@dataclass(frozen=True, slots=True)
class FilmResult:
    """The contents of a film."""

    seconds: float
    pictures: int
    left_out: int  # pictures: damaged, or without those that they build on
    sound: SoundResult | None  # None: none was received


def write_film(
    read: Callable[[], Iterable[Recorded]],
    target: Path,
    robot: str,
    *,
    on_time: Callable[[int], None] = lambda _log_ns: None,
) -> FilmResult:
    """Write the pictures and the sound of ``robot`` (its base) to ``target``, which ends in .mkv or .mp4.

    The messages are read twice: for the sound, then for the pictures, which take longer. ``on_time`` is called for each
    with its log time, or for the sound with 0, so that only the pictures count as progress. If several topics carry
    pictures, or sound, the first one counts. The film has the size of its first picture. Raises RecordingError if there
    are no pictures or ``target`` cannot be written; PebbleError without PyAV.
    """
    if target.suffix not in _FORMATS:
        raise RecordingError(f"{target}: a film ends in {' or '.join(_FORMATS)}")
    av = pyav.load("film")
    container, codec = _FORMATS[target.suffix]
    with unfinished(target) as path:
        wav = path.with_name("sound.wav")  # it may become as large as the film
        try:
            with SoundTrack(wav) as sound:
                for at_ms, payload in _media(reported(read(), lambda _log_ns: on_time(0)), robot):
                    if not is_picture(payload):
                        sound.add(payload, at_ms)
            with av.open(str(path), "w", format=container, options=_MUXER.get(container, {})) as out:
                pictures = _Pictures(av, out)
                media = _media(reported(read(), on_time), robot)
                tracks = [pictures.packets((at_ms, payload) for at_ms, payload in media if is_picture(payload))]
                if sound.result.packets:
                    tracks.append(_sound_packets(av, wav, out, codec))
                for packet in heapq.merge(*tracks, key=lambda packet: packet.dts * packet.time_base):
                    if pictures.count:  # 0: there are none, as merge asks each track for its first packet at once
                        out.mux(packet)
        except av.error.FFmpegError as error:
            raise RecordingError(f"{target}: {error}") from None
        if not pictures.count:
            raise RecordingError(f"{robot}: no pictures; its sound alone can be exported as wav")
    seconds = max((pictures.last_ms + _LAST_PICTURE_MS) / 1000, sound.result.seconds)
    return FilmResult(seconds, pictures.count, pictures.left_out, sound.result if sound.result.packets else None)


def write_wav(messages: Iterable[Recorded], target: Path, robot: str) -> SoundResult:
    """Write the sound of ``robot`` (its base) to ``target``, from its first sample on. Raises RecordingError."""
    with unfinished(target) as path, SoundTrack(path) as track:
        first_ms = None
        for at_ms, payload in _media(messages, robot):
            if not is_picture(payload):
                first_ms = at_ms if first_ms is None else first_ms
                track.add(payload, at_ms - first_ms)
        if not track.result.packets:
            raise RecordingError(f"{robot}: no sound" + ("" if pyav.installed() else f"; Opus {pyav.INSTALL}"))
    return track.result


def _media(messages: Iterable[Recorded], robot: str) -> Iterator[tuple[int, bytes]]:
    """Yield the messages of one topic of pictures and one of sound, with milliseconds since the first message."""
    first_ms = None
    first_topics: dict[str, str] = {}  # of pictures, and of sound: the topic that counts
    for message in messages:
        topic, payload = message.channel.topic, message.payload
        is_old = message.channel.metadata.get("retained") == "1"
        if is_old or not topic.startswith(f"{robot}/{OUTGOING}/") or not is_media(payload):
            continue
        kind = "pictures" if is_picture(payload) else "sound"
        if first_topics.setdefault(kind, topic) == topic:
            log_ms = message.log_ns // 10**6
            first_ms = log_ms if first_ms is None else first_ms
            yield log_ms - first_ms, payload


def _sound_packets(av: Any, path: Path, out: Any, codec: str) -> Iterator[Any]:
    """Yield the sound's packets while the file is read, so that only a part of the sound is in memory."""
    with av.open(str(path), format="wav") as source:
        wav = source.streams.audio[0]
        layout = "mono" if wav.channels == 1 else "stereo"  # wav has no names for them
        stream = out.add_stream(codec, rate=RATE, layout=layout, bit_rate=_BITRATE * wav.channels)
        for frame in source.decode(wav):
            yield from stream.encode(frame)
        yield from stream.encode(None)


class _Pictures:
    """An H.264 stream of the size of its first picture. Others, in any encoding, are scaled to that."""

    def __init__(self, av: Any, out: Any) -> None:
        from pebble.extensions.media.decode import VideoDecoder

        self.count = self.left_out = 0
        self.last_ms = -1
        self._av, self._out, self._decoder = av, out, VideoDecoder()

    def packets(self, pictures: Iterable[tuple[int, bytes]]) -> Iterator[Any]:
        """Yield packets for a stream of ``out``: each picture at its time (ms), but never before the previous one."""
        stream: Any = None
        for at_ms, payload in pictures:
            decoded = self._decoder.feed(payload)
            if decoded is None:  # damaged, or without those that it builds on
                self.left_out += 1
                continue
            if stream is None:
                stream = self._opened(*decoded.picture.shape[:2])
            frame = self._av.VideoFrame.from_ndarray(decoded.picture, format="bgr24")
            self.last_ms = frame.pts = max(at_ms, self.last_ms + 1)
            frame.time_base = _MILLISECOND
            self.count += 1
            yield from _with_durations(stream.encode(frame))
        if stream is not None:
            yield from _with_durations(stream.encode(None))

    def _opened(self, height: int, width: int) -> Any:
        """Open the encoder for the first picture's size, rounded down to even numbers.

        H.264 stores colour for two by two pixels.
        """
        stream = self._out.add_stream("libx264", rate=_NOMINAL_FPS, options=_OPTIONS)
        stream.width, stream.height = width & ~1, height & ~1
        stream.pix_fmt = "yuv420p"
        stream.codec_context.time_base = _MILLISECOND
        stream.codec_context.gop_size = _KEYFRAME_INTERVAL
        stream.codec_context.max_b_frames = 0
        return stream


def _with_durations(packets: list[Any]) -> list[Any]:
    """Return the packets, each with a duration.

    Only the last one's duration counts: the others are shown until the next.
    """
    for packet in packets:
        packet.duration = _LAST_PICTURE_MS
    return packets
