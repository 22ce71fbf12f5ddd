"""The video comparison: similarity measures, clips, and the aims on a short clip."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
import pytest

from pebble.bench.engine import run
from pebble.bench.results import Cell, load
from pebble.bench.wire.clips import SCENES, film
from pebble.bench.wire.ssim import ssim
from pebble.bench.wire.video import AIMS, TOLERANCE, VIDEO, ratio_at_equal_quality


def test_similarity_of_known_pictures() -> None:
    random = np.random.default_rng(1)
    picture = random.integers(0, 256, (64, 64, 3), np.uint8)
    assert ssim(picture, picture) == pytest.approx(1)
    assert ssim(picture, random.integers(0, 256, picture.shape, np.uint8)) < 0.1
    # Flat pictures differ in lightness only: (2ab + C1) / (a² + b² + C1).
    flat = np.full((64, 64, 3), 100, np.uint8)
    assert ssim(flat, flat + 50) == pytest.approx((2 * 100 * 150 + 6.5025) / (100**2 + 150**2 + 6.5025), abs=1e-4)


@pytest.mark.parametrize("scene", SCENES)
def test_the_film_is_always_the_same(scene: str) -> None:
    first, second = film(scene, 5)[3:]
    assert np.array_equal(film(scene, 4)[3], first)
    assert cv2.norm(first, second, cv2.NORM_L2SQR) / first.size > 1


@pytest.mark.thorough
def test_the_aims_hold(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(VIDEO.run_of(quick=True, output=tmp_path)) == 0
    results = load(tmp_path / "video.json")
    assert results.quick
    assert results.command == ["pebble", "bench", "video", "--seconds", "1", "--quick"]
    assert [cell.variant for cell in results.cells[:5]] == ["reference", "json", "pbvd", "pbvz", "h264"]
    for scene in SCENES:
        ours = {cell.variant: cell for cell in results.cells if cell.params["scene"] == scene}
        for name, aim in AIMS.items():
            assert ours[name].percentile(50) <= aim * ours["reference"].percentile(50)
            assert abs(ours[name].figures["ssim"] - ours["reference"].figures["ssim"]) <= TOLERANCE
    assert [aim.outcome for aim in results.aims] == ["met"] * len(AIMS)
    assert str(results.aims[0]) in capsys.readouterr().out


def test_fewer_bytes_at_another_quality_do_not_count() -> None:
    def coded(off: float) -> Cell:
        figures = {"ratio": 0.1, "ssim_off": off}
        return Cell(
            variant="h264", params={"scene": "quiet"}, measure="wire", unit="kB/s", rounds=[[1.0]], figures=figures
        )

    assert ratio_at_equal_quality(coded(TOLERANCE / 2)) == 0.1
    assert ratio_at_equal_quality(coded(-2 * TOLERANCE)) == math.inf
