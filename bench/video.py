"""Measures bytes on the wire at equal quality: each video encoding against the reference's JSON, on the same clip."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from rich import box
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from pebble.bench import output
from pebble.bench.clips import FPS, HEIGHT, SCENES, WIDTH, Clip
from pebble.bench.results import Cell, Stopwatch
from pebble.bench.similarity import psnr, squared_error, ssim
from pebble.errors import PebbleError
from pebble.media.decode import VideoDecoder
from pebble.media.jpeg import Pixels
from pebble.media.video import VIDEO_ENCODINGS, JsonEncoder, VideoEncoder, make_encoder

TOLERANCE: Final = 0.005  # of SSIM
QUALITY, INTERVAL = 10, 5  # the reference implementation's settings
AIMS: Final = {"pbvz": 0.75, "h264": 0.25}
_EVERY: Final = 7  # one picture in so many is compared: not only key frames
_STARTED_MS: Final = 1_700_000_000_000
_TRIES: Final = 8


@dataclass(frozen=True, slots=True)
class Row:
    """One encoding on one scene."""

    scene: str
    variant: str
    quality: float
    n: int  # pictures
    bytes_per_second: float
    ssim: float
    psnr: float
    encode_ms: float
    decode_ms: float


class ReferenceJson(JsonEncoder):
    """Encodes as the reference implementation does, with the Huffman tables of the JPEG standard."""

    optimize = False


Make = Callable[[float], VideoEncoder]


def variants() -> dict[str, Make]:
    """The encoders that are compared; the first is the reference.

    h264 is there twice: with its own interval (key frames on request) and with that of the others.
    """
    made: dict[str, Make] = {"reference": lambda quality: ReferenceJson(INTERVAL, quality)}
    for name in VIDEO_ENCODINGS:
        interval = None if name == "h264" else INTERVAL
        made[name] = lambda quality, name=name, interval=interval: make_encoder(  # type: ignore[misc]
            name, fps=FPS, keyframe_interval=interval, quality=quality
        )
    if "h264" in VIDEO_ENCODINGS:
        made["h264, key/5"] = lambda quality: make_encoder("h264", fps=FPS, keyframe_interval=INTERVAL, quality=quality)
    return made


def measure(film: list[Pixels], scene: str, variant: str, make: Make, quality: float) -> Row:
    """Encodes and decodes the clip."""
    encoder, decoder = make(quality), VideoDecoder()
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
    return Row(
        scene, variant, quality, n, sent * FPS / n, sum(likeness) / len(likeness), psnr(sum(errors) / len(errors)),
        encoding / n * 1000, decoding / n * 1000,
    )  # fmt: skip


def match(film: list[Pixels], scene: str, variant: str, make: Make, wanted: float) -> Row:
    """The row whose SSIM is nearest to ``wanted``, found by bisection; stops within a fifth of the tolerance."""
    low, high = 1.0, 100.0
    quality = float(QUALITY)
    tried: list[Row] = []
    while len(tried) < _TRIES:
        row = measure(film, scene, variant, make, quality)
        tried.append(row)
        if abs(row.ssim - wanted) <= TOLERANCE / 5:
            break
        low, high = (quality, high) if row.ssim < wanted else (low, quality)
        quality = (low * high) ** 0.5
    return min(tried, key=lambda row: abs(row.ssim - wanted))


def run(
    folder: Path = output.FOLDER, seconds: float | None = None, *, quick: bool = False, console: Console | None = None
) -> int:
    """Returns 0 if every encoding reached the reference's quality. The clip lasts 10 s, or 1 s with ``quick``."""
    seconds = seconds or (1.0 if quick else 10.0)
    console = console or Console()
    output.check_folder(folder)
    command = ["pebble", "bench", "video", "--seconds", f"{seconds:g}", *(["--quick"] if quick else [])]
    watch = Stopwatch("video", command, {"seconds": seconds})
    rows: list[Row] = []
    with Progress(console=console, transient=True) as progress:
        task = progress.add_task("coding", total=len(SCENES) * len(variants()))
        for scene in SCENES:
            clip = Clip(scene)
            film = [clip.frame(number) for number in range(max(_EVERY, round(seconds * FPS)))]
            for variant, make in variants().items():
                progress.update(task, description=f"{scene}: {variant}")
                rows.append(
                    match(film, scene, variant, make, reference(rows, scene).ssim)
                    if any(row.scene == scene for row in rows)
                    else measure(film, scene, variant, make, QUALITY)
                )
                progress.advance(task)
    console.print(table(rows))
    results = watch.results([_cell(rows, row) for row in rows], assessment(rows), quick=quick)
    output.finish(results, folder, console)
    return int(bool(unequal(rows)))


def reference(rows: list[Row], scene: str) -> Row:
    """The first row of a scene."""
    return next(row for row in rows if row.scene == scene)


def ratio(rows: list[Row], row: Row) -> float:
    return row.bytes_per_second / reference(rows, row.scene).bytes_per_second


def unequal(rows: list[Row]) -> list[str]:
    """The encodings that did not reach the reference's quality, one line each."""
    away = {f"{row.scene}, {row.variant}": row.ssim - reference(rows, row.scene).ssim for row in rows}
    return [
        f"{form}: SSIM differs by {far:+.4f}, quality is not equal"
        for form, far in away.items()
        if abs(far) > TOLERANCE
    ]


def table(rows: list[Row]) -> Table:
    title = f"Video on the wire at equal SSIM, {WIDTH}x{HEIGHT}, {FPS} fps"
    made = Table(title=title, box=box.SIMPLE_HEAD, pad_edge=False, collapse_padding=True)
    for name in ("scene", "encoding"):
        made.add_column(name, no_wrap=True)
    for name in ("quality", "bytes/s", "ratio", "SSIM", "PSNR", "enc ms", "dec ms"):
        made.add_column(name, justify="right", no_wrap=True)
    for row in rows:
        made.add_row(
            row.scene, row.variant, f"{row.quality:.1f}", f"{row.bytes_per_second:,.0f}",
            f"{ratio(rows, row):.3f}", f"{row.ssim:.4f}", f"{row.psnr:.2f}",
            f"{row.encode_ms:.2f}", f"{row.decode_ms:.2f}",
            end_section=row is rows[-1] or rows[rows.index(row) + 1].scene != row.scene,
        )  # fmt: skip
    return made


def assessment(rows: list[Row]) -> list[str]:
    """The aims, for the worst scene of each encoding, and the encodings that could not be compared."""
    worst = {name: max(ratio(rows, row) for row in rows if row.variant == name) for name in AIMS}
    lines = [
        f"aim: {name} takes at most {aim:.2f} of the reference's bytes at equal quality:"
        f" {'met' if worst[name] <= aim else 'missed'} ({worst[name]:.2f})"
        for name, aim in AIMS.items()
    ]
    return [*lines, *unequal(rows)]


def _cell(rows: list[Row], row: Row) -> Cell:
    """One sample per cell: bytes are the same in every run with the same programs."""
    return Cell(
        variant=row.variant,
        params={"scene": row.scene, "size": f"{WIDTH}x{HEIGHT}", "fps": FPS},
        measure="wire",
        unit="kB/s",
        rounds=[[row.bytes_per_second / 1000]],
        figures={
            "quality": round(row.quality, 1),
            "pictures": row.n,
            "ratio": round(ratio(rows, row), 4),
            "ssim": round(row.ssim, 4),
            "psnr_db": round(row.psnr, 2),
            "encode_ms": round(row.encode_ms, 3),
            "decode_ms": round(row.decode_ms, 3),
        },
    )
