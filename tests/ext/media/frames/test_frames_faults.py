"""Readers and writers are killed and stopped at random, and the others go on."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.ext.media.frames.frames_faults import Faults
from tests.ext.media.frames.frames_net import FramesNet


@pytest.fixture
def net(tmp_path: Path) -> Iterator[FramesNet]:
    net = FramesNet(tmp_path / "run")
    yield net
    net.close()


@pytest.mark.thorough
def test_the_others_get_what_is_written_and_nothing_is_left(net: FramesNet) -> None:
    figures = Faults(net, seed=3).run(6)
    assert figures.wrong == 0
    assert min(figures.shares) >= 0.95, figures
    assert figures.segments_left == 0
    for before, after in zip(*figures.memory_kb, strict=True):
        assert after - before < 30_000
