"""Measures bytes on the wire at equal quality: each video encoding against the reference's JSON, on the same clip."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np

from pebble.bench.aims import Aim, single
from pebble.bench.clips import FPS, HEIGHT, SCENES, WIDTH, Clip
from pebble.bench.comparison import Budget, Case, Comparison, Round, seconds
from pebble.bench.pictures import bars
from pebble.bench.results import Cell
from pebble.bench.tables import Grid, percentile_column, single_column
from pebble.errors import PebbleError
from pebble.media.decode import VideoDecoder
from pebble.media.jpeg import Pixels
from pebble.media.video import VIDEO_ENCODINGS, JsonEncoder, VideoEncoder, make_encoder

TOLERANCE: Final = 0.005  # of SSIM
QUALITY, INTERVAL = 10, 5  # the reference implementation's settings
AIMS: Final = {"pbvz": 0.75, "h264": 0.25}
_REFERENCE: Final = "reference"
_EVERY: Final = 7  # one picture in so many is compared: not only key frames
_STARTED_MS: Final = 1_700_000_000_000
_TRIES: Final = 8

Make = Callable[[float], VideoEncoder]


class ReferenceJson(JsonEncoder):
    """Encodes as the reference implementation does, with the Huffman tables of the JPEG standard."""

    optimize = False


def variants() -> dict[str, Make]:
    """The encoders that are compared; the first is the reference.

    h264 is there twice: with its own interval (key frames on request) and with that of the others.
    """
    made: dict[str, Make] = {_REFERENCE: lambda quality: ReferenceJson(INTERVAL, quality)}
    for name in VIDEO_ENCODINGS:
        interval = None if name == "h264" else INTERVAL
        made[name] = lambda quality, name=name, interval=interval: make_encoder(  # type: ignore[misc]
            name, fps=FPS, keyframe_interval=interval, quality=quality
        )
    if "h264" in VIDEO_ENCODINGS:
        made["h264, key/5"] = lambda quality: make_encoder("h264", fps=FPS, keyframe_interval=INTERVAL, quality=quality)
    return made


@dataclass(frozen=True, slots=True)
class Coded:
    """One clip in one encoding of one quality."""

    quality: float
    bytes_per_second: float
    ssim: float
    psnr: float
    encode_ms: float
    decode_ms: float


def code(film: Sequence[Pixels], variant: str, quality: float) -> Coded:
    """Encodes and decodes the clip. Raises PebbleError if a picture cannot be decoded."""
    encoder, decoder = variants()[variant](quality), VideoDecoder()
    sent, likeness, errors = 0, [], []
    encoding = decoding = 0.0
    for number, picture in enumerate(film):
        began = time.perf_counter()
        payload = encoder.encode(picture, _STARTED_MS + number * 1000 // FPS)
        encoded = time.perf_counter()
        shown = decoder.feed(payload)
        decoding += time.perf_counter() - encoded
        encoding += encoded - began
        sent += len(payload)
        if shown is None:
            raise PebbleError(f"{variant}: picture {number} was not decoded: {decoder.problem}")
        if number % _EVERY == 0:
            likeness.append(ssim(picture, shown.picture))
            errors.append(squared_error(picture, shown.picture))
    n = len(film)
    return Coded(
        quality, sent * FPS / n, sum(likeness) / len(likeness), psnr(sum(errors) / len(errors)), encoding / n * 1000,
        decoding / n * 1000,
    )  # fmt: skip


def match(film: Sequence[Pixels], variant: str, wanted: float) -> Coded:
    """The one whose SSIM is nearest to ``wanted``, found by bisection; stops within a fifth of the tolerance."""
    low, high = 1.0, 100.0
    quality = float(QUALITY)
    tried: list[Coded] = []
    while len(tried) < _TRIES:
        one = code(film, variant, quality)
        tried.append(one)
        if abs(one.ssim - wanted) <= TOLERANCE / 5:
            break
        low, high = (quality, high) if one.ssim < wanted else (low, quality)
        quality = (low * high) ** 0.5
    return min(tried, key=lambda one: abs(one.ssim - wanted))


def measure(round_: Round) -> Iterator[Cell]:
    """Bytes are the same in every run with the same programs: one sample per cell."""
    films: dict[str, list[Pixels]] = {}
    references: dict[str, Coded] = {}
    count = max(_EVERY, round(round_.run["seconds"] * FPS))
    for case in round_.cases():
        scene = str(case.condition["scene"])
        if scene not in films:
            clip = Clip(scene)
            films[scene] = [clip.frame(number) for number in range(count)]
        if case.variant == _REFERENCE:
            coded = references[scene] = code(films[scene], case.variant, QUALITY)
        else:
            coded = match(films[scene], case.variant, references[scene].ssim)
        yield _cell(case, coded, references[scene], count)


def _cell(case: Case, coded: Coded, reference: Coded, count: int) -> Cell:
    return case.cell(
        "wire", "kB/s", [coded.bytes_per_second / 1000],
        quality=round(coded.quality, 1),
        pictures=count,
        ratio=round(coded.bytes_per_second / reference.bytes_per_second, 4),
        ssim=round(coded.ssim, 4),
        psnr_db=round(coded.psnr, 2),
        encode_ms=round(coded.encode_ms, 3),
        decode_ms=round(coded.decode_ms, 3),
    )  # fmt: skip


# -- the quality of a decoded picture: PSNR over all colours, and SSIM (Wang et al. 2004) as the mean of the channels

_WINDOW, _SIGMA = (11, 11), 1.5  # the paper's Gaussian window
_C1, _C2 = (0.01 * 255) ** 2, (0.03 * 255) ** 2


def squared_error(one: Pixels, other: Pixels) -> float:
    """Mean over all pixels and channels, in levels squared."""
    return float(cv2.norm(one, other, cv2.NORM_L2SQR)) / one.size


def psnr(mean_squared_error: float) -> float:
    """In dB; infinite for identical pictures."""
    return math.inf if mean_squared_error == 0 else 10 * math.log10(255**2 / mean_squared_error)


def ssim(one: Pixels, other: Pixels) -> float:
    """1 for identical pictures. BGR, of one shape. (Borders are reflected; the paper leaves them out.)"""
    x, y = one.astype(np.float32), other.astype(np.float32)
    mean_x, mean_y = _smooth(x), _smooth(y)
    both, squares = mean_x * mean_y, mean_x * mean_x + mean_y * mean_y
    covariance = _smooth(x * y) - both
    variances = _smooth(x * x + y * y) - squares
    likeness = (2 * both + _C1) * (2 * covariance + _C2) / ((squares + _C1) * (variances + _C2))
    return float(likeness.mean())


def _smooth(values: np.ndarray) -> np.ndarray:
    return cv2.GaussianBlur(values, _WINDOW, _SIGMA)


# -- the report


def unequal(cells: Sequence[Cell]) -> Iterator[str]:
    """The encodings that did not reach the reference's quality."""
    likeness = single("ssim")
    wanted = {cell.params["scene"]: likeness(cell) for cell in cells if cell.variant == _REFERENCE}
    for cell in cells:
        far = likeness(cell) - wanted[cell.params["scene"]]
        if abs(far) > TOLERANCE:
            yield f"{cell.params['scene']}, {cell.variant}: SSIM differs by {far:+.4f}, quality is not equal"


VIDEO = Comparison(
    name="video",
    title="Video on the wire",
    what="Bytes of each video encoding at equal quality (SSIM) on the same synthetic clips. Nothing is sent: this "
    "is the encoders' output.",
    help="Video on the wire: bytes of every encoding at equal quality, for the same film.",
    options=(seconds("Length of the film.", least=1),),
    full=Budget(60, seconds=10.0),
    quick=Budget(8, seconds=1.0),
    variants=tuple(variants()),
    conditions=lambda _run: [{"scene": scene, "size": f"{WIDTH}x{HEIGHT}", "fps": FPS} for scene in SCENES],
    measure_round=measure,
    tables=(
        Grid(
            title=f"Video on the wire at equal SSIM, {WIDTH}x{HEIGHT}, {FPS} fps", rows=("scene", "variant"),
            heads=("scene", "encoding"),
            columns=(percentile_column(50, "kB/s"), *(single_column(*words) for words in (
                ("quality", "quality", ".1f"), ("ratio", "ratio", ".3f"), ("SSIM", "ssim", ".4f"),
                ("PSNR", "psnr_db", ".2f"), ("enc ms", "encode_ms", ".2f"), ("dec ms", "decode_ms", ".2f"),
            ))),
        ),
    ),
    assessment=(unequal, *(
        Aim(
            what=f"{name} takes at most {{bound:.2f}} of the reference's bytes at equal quality",
            of=lambda cell, name=name: cell.variant == name,  # type: ignore[misc]
            value=single("ratio"), at_most=aim, worst=True, shown="{:.2f}".format,
        )
        for name, aim in AIMS.items()
    )),
    complete=lambda cells: not any(unequal(cells)),
    pictures=(bars("Video at equal quality"),),
)  # fmt: skip
