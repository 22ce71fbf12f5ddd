"""Measures bytes of each video encoding at equal quality."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from functools import lru_cache
from statistics import fmean
from typing import Any, Final

from pebble.bench.comparison import Budget, Case, Comparison, Measuring, Report, seconds
from pebble.bench.judging.aims import Aim
from pebble.bench.pictures import bars
from pebble.bench.results import Cell
from pebble.bench.tables import Grid, percentile_column, single_column
from pebble.bench.wire.cells import Coded, wire_cell
from pebble.bench.wire.clips import FPS, HEIGHT, SCENES, WIDTH, film
from pebble.bench.wire.ssim import ssim
from pebble.errors import PebbleError
from pebble.media.decode import VideoDecoder
from pebble.media.jpeg import Pixels
from pebble.media.video import VIDEO_ENCODINGS, JsonEncoder, make_encoder

TOLERANCE: Final = 0.005  # of SSIM
QUALITY, INTERVAL = 10, 5  # the reference implementation's settings
AIMS: Final = {"pbvz": 0.75, "h264": 0.25}
_REFERENCE: Final = "reference"
#: h264 is there twice: with its own interval (key frames on request) and with that of the others.
_VIDEO: Final = (_REFERENCE, *VIDEO_ENCODINGS, *(["h264, key/5"] if "h264" in VIDEO_ENCODINGS else []))
_EVERY: Final = 7  # one picture in so many is compared: not only key frames
_STARTED_MS: Final = 1_700_000_000_000
_TRIES: Final = 8


class _ReferenceJson(JsonEncoder):
    """Encodes as the reference implementation does, with the Huffman tables of the JPEG standard."""

    optimize = False


def code(pictures: Sequence[Pixels], variant: str, quality: float) -> Coded:
    """Encodes and decodes the clip. Raises PebbleError if a picture cannot be decoded."""
    name, interval = variant.partition(",")[0], None if variant == "h264" else INTERVAL
    options: dict[str, Any] = {"fps": FPS, "keyframe_interval": interval, "quality": quality}
    encoder = _ReferenceJson(INTERVAL, quality) if name == _REFERENCE else make_encoder(name, **options)
    decoder, likeness = VideoDecoder(), list[float]()
    sent, encoding, decoding = 0, 0.0, 0.0
    for number, picture in enumerate(pictures):
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
    per_picture = 1 / len(pictures)
    return {
        "wire": sent * per_picture * FPS / 1000,
        "quality": quality,
        "ssim": fmean(likeness),
        "encode_ms": encoding * per_picture * 1000,
        "decode_ms": decoding * per_picture * 1000,
    }


def match(pictures: Sequence[Pixels], variant: str, wanted: float) -> Coded:
    """The one whose SSIM is nearest to ``wanted``, found by bisection; stops within a fifth of the tolerance."""
    low, high, quality = 1.0, 100.0, float(QUALITY)
    tried: list[Coded] = []
    for _ in range(_TRIES):
        tried.append(one := code(pictures, variant, quality))
        if abs(one["ssim"] - wanted) <= TOLERANCE / 5:
            break
        low, high = (quality, high) if one["ssim"] < wanted else (low, quality)
        quality = (low * high) ** 0.5
    return min(tried, key=lambda one: abs(one["ssim"] - wanted))


def measure_video(case: Case) -> Iterator[Cell]:
    scene, count = str(case.condition["scene"]), max(_EVERY, round(case.run["seconds"] * FPS))
    pictures, reference = _filmed(scene, count)
    coded = reference if case.variant == _REFERENCE else match(pictures, case.variant, reference["ssim"])
    yield wire_cell(case, "kB/s", coded, reference)


@lru_cache(1)
def _filmed(scene: str, count: int) -> tuple[list[Pixels], Coded]:
    """A clip, and what the reference makes of it."""
    pictures = film(scene, count)
    return pictures, code(pictures, _REFERENCE, QUALITY)


def unequal(cells: Sequence[Cell]) -> Iterator[str]:
    """The encodings that did not reach the reference's quality."""
    for cell in cells:
        if abs(off := cell.single("ssim_off")) > TOLERANCE:
            yield f"{cell.params['scene']}, {cell.variant}: SSIM differs by {off:+.4f}, quality is not equal"


def ratio_at_equal_quality(cell: Cell) -> float:
    return cell.single("ratio") if abs(cell.single("ssim_off")) <= TOLERANCE else math.inf


VIDEO = Comparison(
    name="video",
    title="Video on the wire",
    what="Bytes of each video encoding at equal quality (SSIM) on the same synthetic clips. Nothing is sent: this "
    "is the encoders' output.",
    help="Video on the wire: bytes of every encoding at equal quality, for the same film.",
    options=(seconds("Length of the film.", least=1),),
    full=Budget(60, seconds=10.0),
    quick=Budget(8, seconds=1.0),
    variants=_VIDEO,
    conditions=lambda _run: [{"scene": scene, "size": f"{WIDTH}x{HEIGHT}", "fps": FPS} for scene in SCENES],
    measuring=Measuring(measure=measure_video),
    report=Report(
        tables=(
            Grid(
                title=f"Video on the wire at equal SSIM, {WIDTH}x{HEIGHT}, {FPS} fps", rows=("scene", "variant"),
                heads=("scene", "encoding"),
                columns=(
                    percentile_column(50, "kB/s"), single_column("quality", "quality", ".1f"),
                    single_column("ratio", "ratio", ".3f"), single_column("SSIM", "ssim", ".4f"),
                    single_column("enc ms", "encode_ms", ".2f"), single_column("dec ms", "decode_ms", ".2f"),
                ),
            ),
        ),
        assessment=(unequal, *(
            Aim(
                what=f"{name} takes at most {{bound:.2f}} of the reference's bytes at equal quality",
                of=lambda cell, name=name: cell.variant == name,  # type: ignore[misc]
                value=ratio_at_equal_quality, at_most=aim, worst=True,
                shown="{:.2f}".format, never="not at equal quality",
            )
            for name, aim in AIMS.items()
        )),
        complete=lambda cells: not any(unequal(cells)),
        pictures=(bars("Video at equal quality"),),
    ),
)  # fmt: skip
