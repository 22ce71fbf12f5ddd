"""Writes sound files in formats that need PyAV."""

from __future__ import annotations

from pathlib import Path

import av
import numpy as np

from pebble.extensions.media.pcm import Samples

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
