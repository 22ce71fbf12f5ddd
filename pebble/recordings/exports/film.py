"""One robot's pictures and sound as a film, or its sound alone: each where its capture stamp says, on one clock.

H.264 is copied as it was sent as long as one set of parameters decodes all of it. Other pictures, or parameters that
change, make the film be encoded: what was copied so far is decoded and encoded, too.
"""

from __future__ import annotations

import heapq
import io
import os
import re
import tempfile
import wave
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from pebble.contract import OUTGOING
from pebble.contract.packets import KEY_FRAME, PBAT, PBVD, Picture, PictureKind
from pebble.errors import PayloadError, PebbleError
from pebble.media import pyav
from pebble.recordings.exports.lines import Progress
from pebble.recordings.files.mcap import Recorded
from pebble.recordings.files.reader import RecordingError
from pebble.recordings.stamps import is_picture

if TYPE_CHECKING:
    from pebble.media.jpeg import Pixels
    from pebble.media.pcm import Resampler, Samples
    from pebble.media.sound import ReceivedSound

#: By the ending of the film: FFmpeg's names of the container and of the encoder of its sound.
_FORMATS: Final = {".mkv": ("matroska", "libopus"), ".mp4": ("mp4", "aac")}
_PYAV: Final = 15  # older ones cannot make a stream out of packets that another encoder made
QUALITY: Final = 70.0  # of pictures that are encoded, as of a JPEG
_KEYFRAME_INTERVAL: Final = 60  # pictures: how far a player jumps
_NOMINAL_FPS: Final = 15.0  # for the encoder; the times of pictures are their stamps

_BITRATE: Final = 64_000  # bits per second of each channel
RATE: Final = 48_000  # Hz of the film's sound, whatever was sent: the rate of Opus
_HOLE_MS: Final = 60  # sound that is missing for longer becomes silence; less is the jitter of stamps
_WAV_BYTES: Final = (1 << 32) - (1 << 16)  # the format's lengths have 32 bits

_MILLISECOND: Final = Fraction(1, 1000)
_LAST_PICTURE_MS: Final = 66  # how long a film of one picture is
_BACK_MS: Final = 1000  # a stamp so far behind the one before it is of a clock that was set
_AHEAD_MS: Final = 10_000  # or so far ahead of its reception, if it came as fast as the first one

_start_codes = re.compile(rb"\x00\x00\x01")
_PARAMETER_SETS: Final = (7, 8)  # types of NAL units: ITU-T H.264, 7.4.1


@dataclass(slots=True)
class SoundResult:
    """What a film's sound is made of."""

    seconds: float = 0.0
    silence_s: float = 0.0  # of these: no sound was received
    packets: int = 0
    left_out: int = 0  # packets: damaged, or of a time that already had sound


@dataclass(frozen=True, slots=True)
class FilmResult:
    """What a film is made of."""

    seconds: float
    pictures: int
    left_out: int  # pictures: damaged, or without those that they build on
    width: int
    height: int
    scaled: int  # pictures of another size than the film
    copied: bool  # H.264 as it was sent; False: encoded again
    clock_steps: int  # how often the robot's clock was set meanwhile
    sound: SoundResult | None  # None: none was received


def write_film(
    messages: Iterable[Recorded],
    target: Path,
    robot: str,
    *,
    overwrite: bool = False,
    quality: float = QUALITY,
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
            clock, pictures = _FilmClock(), _PictureTrack(av, folder, quality)
            with _SoundTrack(folder / "sound.wav") as sound:
                for message in _media(messages, robot, on_time):
                    if is_picture(message.payload):
                        pictures.add(message.payload, clock.of("pictures", message))
                    else:
                        sound.add(message.payload, clock.of("sound", message))
            pictures.close()
            if pictures.count == 0:
                raise RecordingError(f"{robot}: no pictures; its sound alone can be exported as wav")
            _join(av, pictures.path, sound.path if sound.result.packets else None, path, target.suffix)
        except av.error.FFmpegError as error:
            raise RecordingError(f"{target}: {error}") from None
    return pictures.result(clock.steps, sound.result if sound.result.packets else None)


def write_wav(
    messages: Iterable[Recorded],
    target: Path,
    robot: str,
    *,
    overwrite: bool = False,
    on_time: Progress | None = None,
) -> SoundResult:
    """Write the sound of ``robot`` (its base) to ``target``, from its first sample on. Raises RecordingError."""
    clock = _FilmClock()
    with unfinished(target, overwrite=overwrite) as path, _SoundTrack(path) as track:
        for message in _media(messages, robot, on_time):
            if not is_picture(message.payload):
                track.add(message.payload, clock.of("sound", message))
        if not track.result.packets:
            raise RecordingError(f"{robot}: no sound" + ("" if pyav.installed() else f"; Opus {pyav.INSTALL}"))
    return track.result


def _pyav() -> Any:
    """Raises PebbleError."""
    av = pyav.load("film")
    if int(av.__version__.partition(".")[0]) < _PYAV:
        raise PebbleError(f"film needs PyAV {_PYAV} or newer, this is {av.__version__}")
    return av


@contextmanager
def unfinished(target: Path, *, overwrite: bool) -> Iterator[Path]:
    """A path beside ``target`` to write to: it becomes ``target`` at the end, and is removed after an error.

    Raises RecordingError if there is a file already, no folder, or no room.
    """
    if target.exists() and not overwrite:
        raise RecordingError(f"{target} exists already")
    if not target.parent.is_dir():
        raise RecordingError(f"{target.parent}: there is no such folder")
    path = target.with_name(f".{target.name}.{os.getpid()}")
    try:
        yield path
        path.replace(target)
    except OSError as error:
        raise RecordingError(f"{target}: {error.strerror or error}") from None
    finally:
        path.unlink(missing_ok=True)


@contextmanager
def _folder_beside(target: Path) -> Iterator[Path]:
    """For files that may be as large as the film: a folder for temporary files is often in memory."""
    with tempfile.TemporaryDirectory(dir=target.parent, prefix=f".{target.name}.") as name:
        yield Path(name)


def _media(messages: Iterable[Recorded], robot: str, on_time: Progress | None) -> Iterator[Recorded]:
    """The pictures and the sound of one robot, of one topic each."""
    below, topics = f"{robot}/{OUTGOING}/", dict[bool, str]()
    for message in messages:
        if on_time is not None:
            on_time(message.log_ns)
        topic, payload = message.channel.topic, message.payload
        if topic.startswith(below) and message.channel.metadata.get("retained") != "1":
            picture = is_picture(payload)
            if (picture or payload.startswith(PBAT)) and topics.setdefault(picture, topic) == topic:
                yield message


@dataclass(slots=True)
class _Stream:
    offset_ms: int  # what is added to its stamps
    film_ms: int  # of its last message, before the origin is taken off
    log_ms: int


@dataclass(slots=True)
class _FilmClock:
    """Turns capture stamps into times of the film, the same for all streams of a robot.

    The stamps count, not when a message was received, so a delay moves nothing. But a robot without a battery for its
    clock begins in 1970 and sets it once it is connected: such a step is taken out of all later stamps. Stamps of the
    streams pass it one after the other, so each has its own offset until its own stamps step.
    """

    steps: int = 0
    _origin_ms: int | None = None
    _offset_ms: int | None = None  # of the stream that stepped last
    _streams: dict[str, _Stream] = field(default_factory=dict)

    def of(self, stream: str, message: Recorded) -> Callable[[int | None], int]:
        """To be called with the capture stamp of ``message`` (ms since 1970; None: none); gives ms, at least 0."""
        log_ms = message.log_ns // 1_000_000
        return lambda captured_ms: self._place(stream, captured_ms, log_ms)

    def _place(self, name: str, captured_ms: int | None, log_ms: int) -> int:
        film_ms = log_ms if captured_ms is None else self._stamped(name, captured_ms, log_ms)
        if self._origin_ms is None:
            self._origin_ms = film_ms
        return max(0, film_ms - self._origin_ms)

    def _stamped(self, name: str, captured_ms: int, log_ms: int) -> int:
        if self._offset_ms is None:
            self._offset_ms = log_ms - captured_ms
        back_ms = _BACK_MS if name in self._streams else _AHEAD_MS  # other streams tell less of this one
        stream = self._streams.setdefault(name, _Stream(self._offset_ms, log_ms, log_ms))
        due_ms = stream.film_ms + log_ms - stream.log_ms
        stream.offset_ms = min(
            (stream.offset_ms, self._offset_ms), key=lambda offset_ms: abs(captured_ms + offset_ms - due_ms)
        )
        film_ms = captured_ms + stream.offset_ms
        if film_ms < stream.film_ms - back_ms or film_ms > log_ms + _AHEAD_MS:
            film_ms = due_ms
            self._offset_ms = stream.offset_ms = due_ms - captured_ms
            self.steps += 1
        stream.film_ms, stream.log_ms = film_ms, log_ms
        return film_ms


class _CannotCopyError(Exception):
    """A picture that does not fit those copied so far."""


class _Units:
    """A file of H.264 access units, which are what ``first`` is: Annex B with its parameter sets."""

    def __init__(self, av: Any, path: Path, first: bytes) -> None:
        """Raises PayloadError, or FFmpeg's error, if ``first`` is none."""
        self._packet = av.Packet
        with av.open(io.BytesIO(first), format="h264") as source:
            stream = source.streams.video[0]
            self.width, self.height = stream.width, stream.height
            if not (self.width and self.height):
                raise PayloadError("h264: parameter sets that no decoder takes")
            self._out = av.open(str(path), "w", format="matroska")
            self._stream = self._out.add_stream_from_template(stream, opaque=True)
        self._stream.time_base = _MILLISECOND
        self.last_ms = -1

    def add(self, unit: bytes, at_ms: int, *, keyframe: bool) -> None:
        """A unit whose time is not after the last one's is shown a millisecond after it: later ones build on it."""
        packet = self._packet(unit)
        self.last_ms = max(at_ms, self.last_ms + 1)
        packet.pts = packet.dts = self.last_ms
        packet.time_base, packet.stream, packet.is_keyframe = _MILLISECOND, self._stream, keyframe
        self._out.mux(packet)

    def close(self) -> None:
        self._out.close()


class _Copier:
    """Chooses the H.264 units that can be shown: from a key frame on, without a gap, undamaged."""

    def __init__(self) -> None:
        self._due: int | None = None  # the number that the next unit must have, unless it is a key frame
        self._parameters: list[bytes] | None = None

    def take(self, payload: bytes) -> tuple[Picture, bytes] | None:
        """The packet and its unit; None if it is left out. Raises _CannotCopyError."""
        from pebble.media.h264 import check_unit, unseal

        if not payload.startswith(PBVD):
            raise _CannotCopyError
        due, self._due = self._due, None
        try:
            packet = Picture.unpack(payload)
            keyframe = bool(packet.flags & KEY_FRAME)
            if packet.kind != PictureKind.H264:
                raise _CannotCopyError
            if not keyframe and packet.frame != due:
                return None
            unit = unseal(packet.body)
            check_unit(unit, keyframe)
        except PayloadError:
            return None
        if keyframe:
            self._compare(parameter_sets(unit))
        self._due = (packet.frame + 1) % (1 << 32)
        return packet, unit

    def _compare(self, parameters: list[bytes]) -> None:
        if self._parameters is None:
            self._parameters = parameters
        elif self._parameters != parameters:
            raise _CannotCopyError


class _PictureTrack:
    """The film's pictures, in a file of their own."""

    def __init__(self, av: Any, folder: Path, quality: float) -> None:
        self.path = folder / "copied.mkv"
        self.count = self._left_out = self._scaled = 0
        self._av, self._folder, self._quality = av, folder, quality
        self._copier = _Copier()
        self._encoder: _Encoder | None = None  # None: they are copied
        self._units: _Units | None = None
        self._size = (0, 0)

    def add(self, payload: bytes, place: Callable[[int | None], int]) -> None:
        """``place`` gives the time of a capture stamp."""
        try:
            taken = (
                self._copied(payload, place) if self._encoder is None else self._encoded(self._encoder, payload, place)
            )
        except _CannotCopyError:
            taken = self._encoded(self._encode_what_was_copied(), payload, place)
        self.count += taken
        self._left_out += not taken

    def close(self) -> None:
        if self._units is not None:
            self._units.close()
            self._size = self._units.width, self._units.height

    def result(self, clock_steps: int, sound: SoundResult | None) -> FilmResult:
        last_ms = 0 if self._units is None else self._units.last_ms
        seconds = max((last_ms + _LAST_PICTURE_MS) / 1000, 0.0 if sound is None else sound.seconds)
        copied, scaled = self._encoder is None, 0 if self._encoder is None else self._encoder.scaled
        return FilmResult(seconds, self.count, self._left_out, *self._size, scaled, copied, clock_steps, sound)

    def _copied(self, payload: bytes, place: Callable[[int | None], int]) -> bool:
        taken = self._copier.take(payload)
        if taken is None:
            return False
        packet, unit = taken
        try:
            self._add(unit, place(packet.captured_ms or None), keyframe=bool(packet.flags & KEY_FRAME))
        except (PayloadError, self._av.error.InvalidDataError):
            self._copier = _Copier()
            return False
        return True

    def _encoded(self, encoder: _Encoder, payload: bytes, place: Callable[[int | None], int]) -> bool:
        decoded = encoder.decoder.feed(payload)
        if decoded is None:
            return False
        self._encode(encoder, decoded.picture, place(decoded.captured_ms))
        return True

    def _encode(self, encoder: _Encoder, picture: Pixels, at_ms: int) -> None:
        unit, keyframe = encoder.encode(picture)
        self._add(unit, at_ms, keyframe=keyframe)

    def _add(self, unit: bytes, at_ms: int, *, keyframe: bool) -> None:
        if self._units is None:
            self._units = _Units(self._av, self.path, unit)
        self._units.add(unit, at_ms, keyframe=keyframe)

    def _encode_what_was_copied(self) -> _Encoder:
        encoder = self._encoder = _Encoder(self._quality)
        copied, self.path = self.path, self._folder / "encoded.mkv"
        if self._units is not None:
            self._units.close()
            self._units = None
            with self._av.open(str(copied)) as source:
                for frame in self._decoded(source):
                    self._encode(encoder, frame.to_ndarray(format="bgr24"), round(frame.time * 1000))
            copied.unlink()
        return encoder

    def _decoded(self, source: Any) -> Iterator[Any]:
        for packet in source.demux(video=0):
            try:
                yield from packet.decode()
            except self._av.error.InvalidDataError:  # undamaged, but no H.264: it was never a picture
                self.count -= 1
                self._left_out += 1


class _Encoder:
    """Pictures of any size and encoding to H.264 of one size, that of the first."""

    def __init__(self, quality: float) -> None:
        from pebble.media.decode import VideoDecoder
        from pebble.media.h264 import H264Encoder

        self.decoder = VideoDecoder()
        self.scaled = 0
        self._h264 = H264Encoder(fps=_NOMINAL_FPS, interval=_KEYFRAME_INTERVAL, quality=quality)
        self._shape: tuple[int, ...] | None = None

    def encode(self, picture: Pixels) -> tuple[bytes, bool]:
        """An access unit, and whether it is a key frame."""
        from pebble.media.h264 import unseal

        self._shape = self._shape or picture.shape
        if picture.shape != self._shape:
            picture = _fitted(picture, self._shape)
            self.scaled += 1
        return unseal(self._h264.encode(picture)), self._h264.keyframe


def parameter_sets(unit: bytes) -> list[bytes]:
    """The parameter sets of an access unit in Annex B, without start codes."""
    units = (part.rstrip(b"\0") for part in _start_codes.split(unit))
    return [part for part in units if part and part[0] & 31 in _PARAMETER_SETS]


def _fitted(picture: Pixels, shape: tuple[int, ...]) -> Pixels:
    """As large as fits into ``shape``, in its middle, on black."""
    import cv2
    import numpy as np

    scale = min(shape[0] / picture.shape[0], shape[1] / picture.shape[1])
    height, width = (max(1, round(edge * scale)) for edge in picture.shape[:2])
    top, left = (shape[0] - height) // 2, (shape[1] - width) // 2
    made = np.zeros(shape, np.uint8)
    way = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    made[top : top + height, left : left + width] = cv2.resize(picture, (width, height), interpolation=way)
    return made


class _SoundTrack:
    """The film's sound as a wav file: silence where none was received. The first packet decides mono or stereo."""

    def __init__(self, path: Path) -> None:
        from pebble.media.sound import SoundDecoder

        self.path = path
        self.result = SoundResult()
        self._decoder = SoundDecoder()
        self._file: Any = None
        self._channels = 0
        self._written = 0  # samples
        self._format = (0, 0)
        self._resampler: Resampler | None = None

    def __enter__(self) -> _SoundTrack:
        return self

    def __exit__(self, *_: object) -> None:
        if self._file is not None:
            self._file.close()

    def add(self, payload: bytes, place: Callable[[int | None], int]) -> None:
        """``place`` gives the time of a capture stamp."""
        sound = self._decoder.feed(payload)
        if sound is None:
            self.result.left_out += 1
            return
        if self._file is None:
            self._open(1 if sound.channels == 1 else 2)
        samples = self._resampled(sound)
        missing = place(sound.captured_ms or None) * RATE // 1000 - self._written
        if missing > _HOLE_MS * RATE // 1000 or not self._written:
            self._silence(missing)
        elif missing < -_HOLE_MS * RATE // 1000:
            samples = samples[-missing:]
        if len(samples):
            self.result.packets += 1
            self._write(samples)
        else:
            self.result.left_out += 1

    def _open(self, channels: int) -> None:
        self._channels = channels
        self._file = wave.open(str(self.path), "wb")  # noqa: SIM115 - closed by __exit__
        self._file.setparams((channels, 2, RATE, 0, "NONE", ""))

    def _resampled(self, sound: ReceivedSound) -> Samples:
        from pebble.media.pcm import Resampler, remix

        if self._resampler is None or self._format != (sound.rate, sound.channels):
            self._resampler = Resampler(sound.rate, RATE, self._channels)
            self._format = sound.rate, sound.channels
        return self._resampler.feed(remix(sound.samples, self._channels))

    def _silence(self, samples: int) -> None:
        import numpy as np

        self.result.silence_s += samples / RATE
        while samples > 0:
            part = min(samples, RATE)
            self._write(np.zeros((part, self._channels), np.int16))
            samples -= part

    def _write(self, samples: Samples) -> None:
        from pebble.media.pcm import to_bytes

        self._written += len(samples)
        if self._written * self._channels * 2 > _WAV_BYTES:
            raise RecordingError(f"more than {self._written // RATE // 3600} hours of sound: choose a shorter time")
        self._file.writeframesraw(to_bytes(samples))
        self.result.seconds = self._written / RATE


def _join(av: Any, pictures: Path, sound: Path | None, target: Path, ending: str) -> None:
    """One file of both, in the order of time."""
    container, codec = _FORMATS[ending]
    with av.open(str(target), "w", format=container) as out, av.open(str(pictures)) as source:
        stream = out.add_stream_from_template(source.streams.video[0], opaque=True)
        stream.time_base = _MILLISECOND
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
