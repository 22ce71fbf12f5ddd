"""Sound files as samples."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pebble.errors import PebbleError
from pebble.extensions.media.sound_file import SoundFile
from tests.ext.media.sound_files import encode

SOUND = np.stack([np.arange(-20_000, 20_000, 4), np.arange(20_000, -20_000, -4)], axis=1).astype(np.int16)


def samples(path: Path, rate: int = 8000) -> np.ndarray:
    with SoundFile(path) as file:
        assert file.rate == rate
        return np.frombuffer(b"".join(file.chunks()), "<i2").reshape(-1, file.channels)


def test_flac_is_the_same_and_the_others_as_long(tmp_path: Path) -> None:
    assert np.array_equal(samples(encode(tmp_path / "a.flac", SOUND, 8000)), SOUND)
    assert len(samples(encode(tmp_path / "a.mp3", SOUND, 8000))) == pytest.approx(len(SOUND), abs=3000)
    opus = samples(encode(tmp_path / "a.ogg", SOUND, 48_000), rate=48_000)
    assert len(opus) == pytest.approx(len(SOUND), abs=3000)


@pytest.mark.parametrize("ending", ["mp3", "ogg", "flac"])
@pytest.mark.parametrize("content", [b"", b"#EXTM3U\n#EXTINF:1,\nhttp://127.0.0.1:9/a.mp3\n", bytes(3000)])
def test_what_is_no_sound_is_refused(tmp_path: Path, ending: str, content: bytes) -> None:
    path = tmp_path / f"a.{ending}"
    path.write_bytes(content)
    with pytest.raises(PebbleError, match="a"):
        samples(path)
