"""Measures bytes on the wire: each video encoding at equal quality, each sound encoding with headers of MQTT, TCP, IP.

Nothing is sent. Bytes are the same in every run with the same programs, so there is one sample per cell.
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from statistics import fmean
from typing import Any, Final, cast

import cv2
import numpy as np

from pebble.bench.aims import Aim, single
from pebble.bench.comparison import Budget, Case, Comparison, seconds
from pebble.bench.pictures import bars
from pebble.bench.results import Cell, Value
from pebble.bench.tables import Grid, percentile_column, single_column
from pebble.contract import AUDIO
from pebble.errors import PebbleError
from pebble.media.decode import VideoDecoder
from pebble.media.jpeg import Pixels
from pebble.media.opus import BUNDLE_LIMIT
from pebble.media.pcm import to_bytes
from pebble.media.sound import SoundDecoder, make_sound_encoder
from pebble.media.speech import Speech
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

TOPIC = AUDIO.topic("pebble/robots/goob")
AIM = 0.16  # of PCM's bytes
RATE = 16_000
_HEADERS = 20 + 32  # bytes: IP version 4 without options, TCP with time stamps as Linux sends them
_CHUNK_MS = 20

Coded = dict[str, float]  # figures of a clip or of speech in one encoding; "wire": per second


def _cell(case: Case, unit: str, coded: Coded, reference: Coded, params: dict[str, Value] | None = None) -> Cell:
    found = {**coded, "ratio": coded["wire"] / reference["wire"]}
    if "ssim" in coded:
        found["ssim_off"] = coded["ssim"] - reference["ssim"]
    figures = {name: round(value, 4) for name, value in found.items() if name != "wire"}
    return case.cell("wire", unit, [coded["wire"]], params, **figures)


# -- video


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
    yield _cell(case, "kB/s", coded, reference)


@lru_cache(1)
def _filmed(scene: str, count: int) -> tuple[list[Pixels], Coded]:
    """A clip, and what the reference makes of it."""
    pictures = film(scene, count)
    return pictures, code(pictures, _REFERENCE, QUALITY)


# -- clips: natural textures, a panning or resting camera, sensor noise

WIDTH, HEIGHT, FPS = 640, 480, 15
SCENES: Final = ("panning", "quiet")
_WORLD_WIDTH: Final = 2400
_MARGIN: Final = 48  # pixels of the world around the window


def film(scene: str, count: int) -> list[Pixels]:
    """BGR, always the same: a figure crosses the picture and moves against the background."""
    random, pictures = np.random.default_rng(8), []
    world = _world(random)
    # as of a small sensor in daylight: a standard deviation of 2 in levels of 255
    noise = random.normal(0, 2.0, (HEIGHT + 64, WIDTH + 64, 3)).astype(np.float32)
    for number in range(count):
        view = _view(world, scene, number)
        x, y = round(40 + number * 3.7) % WIDTH, 300
        cv2.ellipse(view, (x, y), (22, 60), 0, 0, 360, (52, 60, 140), -1, cv2.LINE_AA)
        cv2.circle(view, (x, y - 74), 17, (120, 150, 190), -1, cv2.LINE_AA)
        down, right = (number * 29) % 64, (number * 47) % 64  # another part of the noise in each frame
        grain = noise[down : down + HEIGHT, right : right + WIDTH]
        pictures.append(np.clip(view + grain + 0.5, 0, 255).astype(np.uint8))
    return pictures


def _view(world: Pixels, scene: str, number: int) -> Pixels:
    """A window onto the world. While panning it also rotates and zooms, so that no block is merely shifted."""
    along, sway, lean, scale = 300.0, 0.0, 0.0, 1.0
    if scene == "panning":  # in pixels and degrees: a robot that turns at about 10 degrees per second
        along, sway = number * 7.3, 3.0 * math.sin(number / 4)
        lean, scale = 1.5 * math.sin(number / 9), 1 + 0.05 * math.sin(number / 21)
    span = _WORLD_WIDTH - WIDTH - 2 * _MARGIN
    left = _MARGIN + span - abs(along % (2 * span) - span)  # forth and back
    middle_x, middle_y = left + WIDTH / 2, HEIGHT / 2 + _MARGIN + sway
    turn = cv2.getRotationMatrix2D((middle_x, middle_y), lean, scale)
    turn[:, 2] += np.array((WIDTH / 2 - middle_x, HEIGHT / 2 - middle_y))
    return cast(Pixels, cv2.warpAffine(world, turn, (WIDTH, HEIGHT), flags=cv2.INTER_CUBIC))


def _world(random: np.random.Generator) -> Pixels:
    """Octaves of noise of decreasing strength, like the 1/f spectrum of landscapes, and some edges."""
    height, width = HEIGHT + 2 * _MARGIN, _WORLD_WIDTH
    world = np.zeros((height, width, 3), np.float32)
    for octave in range(8):
        cells = (2 + (height >> (8 - octave)), 2 + (width >> (8 - octave)))
        light = random.normal(0, 1, (*cells, 1)) + 0.15 * random.normal(0, 1, (*cells, 3))
        clouds = cv2.resize(light.astype(np.float32), (width, height), interpolation=cv2.INTER_CUBIC)
        world += 48 * 0.66**octave * clouds
    world += np.linspace(165, 85, height, dtype=np.float32)[:, None, None]  # the sky is brighter than the ground
    view = np.clip(world, 0, 255).astype(np.uint8)
    for _ in range(40):  # houses, posts, doors
        x, y = int(random.integers(0, width)), int(random.integers(60, height - 60))
        w, h = int(random.integers(8, 120)), int(random.integers(20, 180))
        patch, colour = view[y : y + h, x : x + w], random.integers(30, 220, 3)
        patch[:] = (patch * 0.3 + colour * 0.7).astype(np.uint8)
    return view


# -- the quality of a decoded picture


def ssim(one: Pixels, other: Pixels) -> float:
    """SSIM (Wang et al. 2004), the mean of the channels: 1 for identical pictures. BGR, of one shape.

    Borders are reflected; the paper leaves them out.
    """
    c1, c2 = (0.01 * 255) ** 2, (0.03 * 255) ** 2
    smooth = partial(cv2.GaussianBlur, ksize=(11, 11), sigmaX=1.5)  # the paper's window
    x, y = one.astype(np.float32), other.astype(np.float32)
    mean_x, mean_y = smooth(x), smooth(y)
    both, squares = mean_x * mean_y, mean_x * mean_x + mean_y * mean_y
    covariance, variances = smooth(x * y) - both, smooth(x * x + y * y) - squares
    likeness = (2 * both + c1) * (2 * covariance + c2) / ((squares + c1) * (variances + c2))
    return float(likeness.mean())


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
    measure=measure_video,
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
            value=ratio_at_equal_quality, at_most=aim, worst=True, shown="{:.2f}".format, never="not at equal quality",
        )
        for name, aim in AIMS.items()
    )),
    complete=lambda cells: not any(unequal(cells)),
    pictures=(bars("Video at equal quality"),),
)  # fmt: skip


# -- sound


def wire_bytes(payload: int, topic: str = TOPIC) -> int:
    """Size of one PUBLISH with QoS 0 in a TCP segment of its own (MQTT 3.1.1, 3.3)."""
    length = 2 + len(topic.encode()) + payload
    digits = max(1, (length.bit_length() + 6) // 7)  # of the remaining length
    return _HEADERS + 1 + digits + length


def measure_sound(case: Case) -> Iterator[Cell]:
    """One cell per encoding; PCM comes first, as the reference of the others."""
    speech = Speech(RATE).samples(0, round(case.run["seconds"] * RATE))
    pcm = speak(speech, "pcm")
    yield _cell(replace(case, role="pcm"), "kbit/s", pcm, pcm)
    for bitrate, bundle in itertools.product(case.run["bitrates"], range(1, BUNDLE_LIMIT + 1)):
        packet = "1 part" if bundle == 1 else f"{bundle} parts"
        params: dict[str, Value] = {"bitrate": f"{bitrate // 1000} kbit/s", "packet": packet}
        yield _cell(replace(case, role="opus"), "kbit/s", speak(speech, "opus", bitrate, bundle), pcm, params)


def speak(speech: np.ndarray, name: str, bitrate: int = 24_000, bundle: int = 1) -> Coded:
    """Encodes and decodes the speech."""
    encoder = make_sound_encoder(name, rate=RATE, channels=1, chunk_ms=_CHUNK_MS, bitrate=bitrate, bundle=bundle)
    size, decoder, packets = RATE * _CHUNK_MS // 1000, SoundDecoder(), list[bytes]()
    for at in range(0, len(speech), size):
        packets += encoder.encode(to_bytes(speech[at : at + size]), round(1000 * at / RATE))
    received = sum(len(one.samples) for one in map(decoder.feed, packets) if one is not None)
    lasts_s = received / encoder.rate
    return {
        "wire": sum(wire_bytes(len(packet)) for packet in packets) / lasts_s * 8 / 1000,
        "packets_per_s": len(packets) / lasts_s,
        "payload_kbits": sum(map(len, packets)) * 8 / 1000 / lasts_s,
    }


_BUDGET = Budget(6, seconds=10.0, bitrates=(16_000, 24_000, 32_000))
SOUND = Comparison(
    name="sound",
    title="Sound on the wire",
    what="Bytes of each sound encoding with the headers of MQTT, TCP and IP. Nothing is sent: these are the "
    "encoders' bytes for synthetic speech.",
    help="Sound on the wire: bytes of every encoding, with all headers.",
    full=_BUDGET,
    quick=_BUDGET,
    constants={"rate": RATE},
    measure=measure_sound,
    tables=(
        Grid(
            title=f"Sound of {RATE / 1000:g} kHz mono on the wire, chunks of {_CHUNK_MS} ms",
            rows=("variant", "bitrate", "packet"), heads=("encoding", "", ""),
            columns=(
                single_column("pack./s", "packets_per_s", ".1f"), single_column("payload", "payload_kbits", ".1f"),
                percentile_column(50, "wire"), single_column("× PCM", "ratio", ".3f"),
            ),
            caption=f"payload, wire: kbit/s, topic {TOPIC}",
        ),
    ),
    assessment=(
        Aim(
            what=f"Opus with several parts in a packet takes at most {AIM} of PCM's bytes",
            of=lambda cell: cell.variant == "opus" and cell.params["packet"] != "1 part",
            value=single("ratio"), at_most=AIM, worst=True, shown="{:.3f}".format,
        ),
    ),
    pictures=(bars("Sound"),),
)  # fmt: skip
