"""A film shows each picture, and plays each sound, at the time at which it was received."""

from __future__ import annotations

import wave
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import av
import numpy as np
import pytest

from pebble.extensions.media.pcm import to_bytes
from pebble.extensions.media.scene import Scene
from pebble.extensions.media.sound import make_sound_encoder
from pebble.extensions.media.video import make_encoder
from pebble.extensions.recordings.exports.film import write_film, write_wav
from pebble.extensions.recordings.exports.film_sound import RATE
from pebble.extensions.recordings.files.recorded import Channel, Recorded, RecordingError
from tests.kit.scene import read_counter

ROBOT = "pebble/robots/goob"
T0_MS = 1_732_300_000_000
STEP_MS = 66  # between two pictures
DELAY_MS = 40  # from capture to the recorder
FLASH = 20  # the picture that is white, when the click is

CAMERA = Channel(1, f"{ROBOT}/outgoing/front-camera", "application/octet-stream")
MICROPHONE = Channel(2, f"{ROBOT}/outgoing/audio", "application/octet-stream")


def recorded(channel: Channel, captured_ms: int, payload: bytes) -> Recorded:
    return Recorded(channel, 0, (captured_ms + DELAY_MS) * 1_000_000, 0, payload)


def picture(number: int, size: tuple[int, int] = (160, 120)) -> np.ndarray:
    """Numbered, and white above the number if it is the flash."""
    made = np.empty((size[1], size[0], 3), np.uint8)
    Scene(*size).render(number, made)
    if number == FLASH:
        made[: size[1] * 8 // 10] = 255
    return made


def pictures(
    name: str, numbers: Iterable[int], *, size: tuple[int, int] = (160, 120), channel: Channel = CAMERA
) -> list[Recorded]:
    encoder = make_encoder(name, fps=15, quality=40, keyframe_interval=15)
    made = []
    for number in numbers:
        at_ms = T0_MS + number * STEP_MS
        payload = encoder.encode(picture(number, size), at_ms)
        made.append(recorded(channel, at_ms, payload))
    return made


def sound(name: str, rate: int, seconds: float, *, begin_ms: int = 0, channels: int = 1) -> list[Recorded]:
    """Silence with a click of 20 ms at the flash."""
    samples = np.zeros((int(seconds * rate), channels), np.int16)
    click = (FLASH * STEP_MS - begin_ms) * rate // 1000
    tone = 20_000 * np.sin(2 * np.pi * 1000 * np.arange(rate // 50) / rate)
    if 0 <= click < len(samples):
        samples[click : click + len(tone)] = tone[:, None]
    encoder = make_sound_encoder(name, rate=rate, channels=channels)
    made, step = [], rate // 50
    for at in range(0, len(samples), step):
        at_ms = T0_MS + begin_ms + at * 1000 // rate
        payloads = encoder.encode(to_bytes(samples[at : at + step]), at_ms)
        made += [recorded(MICROPHONE, at_ms, payload) for payload in payloads]
    return made


def in_order(*streams: list[Recorded]) -> list[Recorded]:
    return sorted((message for stream in streams for message in stream), key=lambda message: message.log_ns)


class Film(NamedTuple):
    seconds: float
    shown: list[tuple[float, int | None, bool]]  # ms, number, whether it is the flash
    samples: np.ndarray  # each at its time: silence before the first one
    codecs: list[str]
    size: tuple[int, int]

    @property
    def flash_ms(self) -> float:
        return next(at_ms for at_ms, _, flash in self.shown if flash)

    @property
    def click_ms(self) -> float:
        return float(np.argmax(np.abs(self.samples) > 5000)) * 1000 / RATE


def opened(path: Path) -> Film:
    with av.open(str(path)) as film:
        seconds, codecs = film.duration / 1e6, [stream.codec_context.name for stream in film.streams]
        video, size = film.streams.video[0], (film.streams.video[0].width, film.streams.video[0].height)
        shown = []
        for frame in film.decode(video):
            pixels = frame.to_ndarray(format="bgr24")
            shown.append((frame.time * 1000, read_counter(pixels), bool(pixels[: size[1] // 2].mean() > 200)))
        film.seek(0)
        track, parts = film.streams.audio[:1], []
        resampler = av.AudioResampler("s16", "mono", RATE)
        for frame in film.decode(*track) if track else ():
            if not parts:
                parts.append(np.zeros(max(0, round(frame.time * RATE)), np.int16))
            parts += [one.to_ndarray().reshape(-1) for one in resampler.resample(frame)]
        parts += [one.to_ndarray().reshape(-1) for one in resampler.resample(None)] if parts else []
    return Film(seconds, shown, np.concatenate([*parts, np.zeros(0, np.int16)]), codecs, size)


def check_numbers(film: Film) -> None:
    """Each picture is within one of its own time."""
    wrong = [
        (at_ms, number)
        for at_ms, number, flash in film.shown
        if not flash and (number is None or abs(at_ms - number * STEP_MS) >= STEP_MS)
    ]
    assert wrong == []


def part(since: int, until: int, name: str, rate: int, channels: int = 1) -> list[Recorded]:
    """The sound between two times in ms."""
    whole = sound(name, rate, 3.0, channels=channels)
    return [one for one in whole if since <= one.log_ns // 1_000_000 - DELAY_MS - T0_MS < until]


@pytest.mark.parametrize(
    ("ending", "encoding", "received", "silence_s", "seconds"),
    [
        (".mp4", "json", lambda: sound("pcm", 44_100, 3.0), 0.0, 3.0),
        (".mkv", "h264", lambda: part(0, 300, "pcm", 16_000) + part(1000, 3000, "pcm", 16_000), 0.7, 3.0),
        (".mkv", "pbvd", lambda: sound("pcm", 16_000, 2.0, begin_ms=800), 0.8, 2.8),
        (".mkv", "pbvd", lambda: part(0, 1000, "pcm", 8_000) + part(1000, 3000, "opus", 24_000, channels=2), 0.0, 3.0),
    ],
    ids=["whole", "a hole", "begins after the pictures", "rate and channels change"],
)
def test_pictures_and_sound_are_where_they_were_received(
    tmp_path: Path,
    ending: str,
    encoding: str,
    received: Callable[[], list[Recorded]],
    silence_s: float,
    seconds: float,
) -> None:
    target = tmp_path / f"walk{ending}"
    messages = in_order(pictures(encoding, range(45)), received())
    result = write_film(lambda: messages, target, ROBOT)
    film = opened(target)
    assert (result.pictures, result.left_out) == (45, 0)
    assert film.codecs == ["h264", "opus" if ending == ".mkv" else "aac"]
    assert (film.size, len(film.shown)) == ((160, 120), 45)
    check_numbers(film)
    assert result.seconds == pytest.approx(film.seconds, abs=0.1)
    assert result.sound is not None
    assert result.sound.silence_s == pytest.approx(silence_s, abs=0.02)
    assert result.sound.seconds == pytest.approx(seconds, abs=0.07)
    assert film.flash_ms == pytest.approx(FLASH * STEP_MS, abs=1)
    assert film.click_ms == pytest.approx(film.flash_ms, abs=80)
    assert list(tmp_path.iterdir()) == [target]


def test_after_a_lost_h264_picture_the_film_waits_for_a_key_frame(tmp_path: Path) -> None:
    messages = pictures("h264", range(45))
    del messages[20]
    messages[34] = recorded(CAMERA, T0_MS + 35 * STEP_MS, messages[34].payload[:-30])  # damaged
    result = write_film(lambda: messages, tmp_path / "walk.mkv", ROBOT)
    film = opened(tmp_path / "walk.mkv")
    assert [number for _, number, _ in film.shown] == [*range(20), *range(30, 35)]
    assert result.left_out == 9 + 10
    check_numbers(film)


def test_encodings_and_sizes_that_change(tmp_path: Path) -> None:
    parts = [
        pictures("h264", range(12)),
        pictures("json", range(12, 24)),
        pictures("h264", range(24, 36), size=(320, 180)),
        pictures("pbvd", range(36, 45), size=(80, 60)),
    ]
    result = write_film(lambda: in_order(*parts, sound("pcm", 16_000, 3.0)), tmp_path / "walk.mp4", ROBOT)
    film = opened(tmp_path / "walk.mp4")
    assert (result.pictures, film.size) == (45, (160, 120))
    raw = (tmp_path / "walk.mp4").read_bytes()
    assert raw.index(b"moov") < raw.index(b"mdat")  # so that a browser plays it while it loads
    times = [at_ms for at_ms, _, _ in film.shown]
    assert times == pytest.approx([number * STEP_MS for number in range(45)], abs=1)
    assert [number for _, number, _ in film.shown[:20]] == list(range(20))
    assert film.click_ms == pytest.approx(film.flash_ms, abs=80)


def test_other_robots_and_an_operators_voice_are_left_out(tmp_path: Path) -> None:
    other = Channel(7, "pebble/robots/fred/outgoing/front-camera", "application/octet-stream")
    renamed = Channel(8, f"{ROBOT}/outgoing/eye", "application/octet-stream")
    voice = Channel(9, f"{ROBOT}/incoming/audio-stream", "application/octet-stream")
    messages = in_order(
        pictures("json", range(20), channel=renamed),
        pictures("pbvd", range(10, 40), channel=other),
        [recorded(voice, T0_MS, one.payload) for one in sound("pcm", 16_000, 0.2)],
        [recorded(Channel(10, f"{ROBOT}/outgoing/online", "json"), T0_MS, b'{"t":1}')],
    )
    times: list[int] = []
    result = write_film(lambda: messages, tmp_path / "walk.mkv", ROBOT, on_time=times.append)
    assert (result.pictures, result.sound) == (20, None)
    assert [time for time in times if time] == [message.log_ns for message in messages]
    assert opened(tmp_path / "walk.mkv").codecs == ["h264"]


def test_wav(tmp_path: Path) -> None:
    once = sound("pcm", 16_000, 2.0)
    messages = [*in_order(pictures("json", range(3)), once), *once[-90:-40]]  # some came twice
    result = write_wav(messages, tmp_path / "walk.wav", ROBOT)
    with wave.open(str(tmp_path / "walk.wav")) as file:
        assert (file.getframerate(), file.getnchannels()) == (RATE, 1)
        samples = np.frombuffer(file.readframes(file.getnframes()), "<i2")
    assert len(samples) == pytest.approx(2 * RATE, abs=RATE // 50)
    assert (result.seconds, result.left_out) == (len(samples) / RATE, 50)
    assert np.argmax(np.abs(samples) > 5000) / RATE == pytest.approx(FLASH * STEP_MS / 1000, abs=0.02)


def refused(messages: list[Recorded], target: Path) -> str:
    with pytest.raises(RecordingError) as caught:
        write_film(lambda: messages, target, ROBOT)
    return str(caught.value)


def test_what_is_refused(tmp_path: Path) -> None:
    target = tmp_path / "walk.mkv"
    assert "no pictures" in refused(sound("pcm", 16_000, 0.1), target)
    assert ".mkv or .mp4" in refused([], tmp_path / "walk.avi")
    assert "no such folder" in refused([], tmp_path / "none" / "walk.mkv")
    assert list(tmp_path.iterdir()) == []
    target.write_bytes(b"precious")
    assert "exists already" in refused(pictures("pbvd", range(3)), target)
    assert target.read_bytes() == b"precious"
    with pytest.raises(RecordingError, match="no sound"):
        write_wav(pictures("pbvd", range(3)), tmp_path / "walk.wav", ROBOT)
    assert list(tmp_path.iterdir()) == [target]


def test_an_error_on_the_way_leaves_nothing_behind(tmp_path: Path) -> None:
    def broken() -> Iterator[Recorded]:
        yield from pictures("h264", range(5))
        raise RecordingError("the disk is gone")

    with pytest.raises(RecordingError, match="gone"):
        write_film(lambda: broken(), tmp_path / "walk.mkv", ROBOT)
    assert list(tmp_path.iterdir()) == []
