"""Sound files as samples."""

from __future__ import annotations

from pathlib import Path

import av
import numpy as np
import pytest

from pebble.errors import PebbleError
from pebble.extensions.media.pcm import Samples
from pebble.extensions.media.sound_file import SoundFile

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


_CODECS = {".mp3": "libmp3lame", ".ogg": "libopus", ".flac": "flac"}
_FORMATS = {"libmp3lame": "s16p", "libopus": "s16", "flac": "s16"}


def encode(path: Path, samples: Samples, rate: int) -> Path:
    """``samples`` are (samples, channels); one or two channels. Ogg holds Opus, which is decoded at 48 kHz."""
    codec, layout = _CODECS[path.suffix], "mono" if samples.shape[1] == 1 else "stereo"
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=rate, layout=layout)
        stream.format = _FORMATS[codec]
        resampler = av.AudioResampler(format=_FORMATS[codec], layout=layout, rate=rate)
        for start in range(0, len(samples), 1024):
            piece = np.ascontiguousarray(samples[start : start + 1024]).reshape(1, -1)
            frame = av.AudioFrame.from_ndarray(piece, format="s16", layout=layout)
            frame.sample_rate, frame.pts = rate, start
            for made in resampler.resample(frame):
                container.mux(stream.encode(made))
        container.mux(stream.encode(None))
    return path
