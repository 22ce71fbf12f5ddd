"""Sound files as samples."""

from __future__ import annotations

import wave
from pathlib import Path

import numpy as np
import pytest

from pebble.errors import PebbleError
from pebble.media.sound_file import SoundFile, write_wav
from tests.media.sound_files import encode

SOUND = np.stack([np.arange(-20_000, 20_000, 4), np.arange(20_000, -20_000, -4)], axis=1).astype(np.int16)


def write(path: Path, width: int, raw: bytes, channels: int = 2) -> Path:
    with wave.open(str(path), "wb") as file:
        file.setnchannels(channels)
        file.setsampwidth(width)
        file.setframerate(8000)
        file.writeframes(raw)
    return path


def samples(path: Path, volume: float = 1.0, rate: int = 8000) -> np.ndarray:
    with SoundFile(path) as file:
        assert file.rate == rate
        return np.frombuffer(b"".join(file.chunks(volume)), "<i2").reshape(-1, file.channels)


def test_what_is_written_is_read(tmp_path: Path) -> None:
    write_wav(tmp_path / "x.wav", SOUND[:, :1].astype("<i2").tobytes(), 8000)
    assert np.array_equal(samples(tmp_path / "x.wav"), SOUND[:, :1])


@pytest.mark.parametrize("width", [1, 2, 3, 4])
def test_wav_files_of_any_width(tmp_path: Path, width: int) -> None:
    """The lowest bytes are left out; there is one byte only, without sign."""
    wide = (SOUND.astype(np.int64) << 48 >> (64 - 8 * width)).astype("<i8").view(np.uint8).reshape(-1, 8)[:, :width]
    raw = wide.tobytes() if width > 1 else ((SOUND >> 8) + 128).astype(np.uint8).tobytes()
    assert np.array_equal(samples(write(tmp_path / "a.wav", width, raw)), SOUND if width > 1 else SOUND >> 8 << 8)


def test_more_channels_than_two_are_left_as_they_are(tmp_path: Path) -> None:
    assert samples(write(tmp_path / "a.wav", 2, SOUND.tobytes(), channels=4)).shape == (5000, 4)


def test_volume(tmp_path: Path) -> None:
    path = write(tmp_path / "a.wav", 2, SOUND.tobytes())
    assert np.array_equal(samples(path, 0.5), np.rint(SOUND * 0.5).astype(np.int16))
    assert not samples(path, 0.0).any()


def test_flac_is_the_same_and_the_others_as_long(tmp_path: Path) -> None:
    assert np.array_equal(samples(encode(tmp_path / "a.flac", SOUND, 8000)), SOUND)
    assert len(samples(encode(tmp_path / "a.mp3", SOUND, 8000))) == pytest.approx(len(SOUND), abs=3000)
    opus = samples(encode(tmp_path / "a.ogg", SOUND, 48_000), rate=48_000)
    assert len(opus) == pytest.approx(len(SOUND), abs=3000)


def test_a_wav_file_that_only_pyav_reads(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write(tmp_path / "a.wav", 4, SOUND.astype("<f4").tobytes())
    raw = bytearray(path.read_bytes())
    raw[20] = 3  # the format: floating point, -1 to 1
    raw[44:] = (SOUND / 32768).astype("<f4").tobytes()
    path.write_bytes(raw)
    assert np.array_equal(samples(path), SOUND)
    monkeypatch.setattr("pebble.media.pyav.find_spec", lambda _name: None)
    with pytest.raises(PebbleError, match=r"a\.wav is no plain wav file: unknown format: 3"):
        samples(path)


@pytest.mark.parametrize("ending", ["wav", "mp3", "ogg", "flac"])
@pytest.mark.parametrize("content", [b"", b"#EXTM3U\n#EXTINF:1,\nhttp://127.0.0.1:9/a.mp3\n", bytes(3000)])
def test_what_is_no_sound_is_refused(tmp_path: Path, ending: str, content: bytes) -> None:
    path = tmp_path / f"a.{ending}"
    path.write_bytes(content)
    with pytest.raises(PebbleError, match="a"):
        samples(path)


def test_a_missing_file(tmp_path: Path) -> None:
    with pytest.raises((OSError, PebbleError), match="No such file"):
        samples(tmp_path / "a.mp3")
