"""Bytes of sound on the wire."""

from __future__ import annotations

import re
from io import StringIO
from pathlib import Path

import pytest
from rich.console import Console

from pebble.bench.engine import run
from pebble.bench.results import load
from pebble.bench.wire.sound import AIM, SOUND, wire_bytes


@pytest.mark.parametrize(
    ("payload", "expected"),
    [(664, 52 + 3 + 2 + 33 + 664), (80, 52 + 2 + 2 + 33 + 80), (92, 52 + 2 + 127), (93, 52 + 3 + 128)],
)
def test_a_publish_on_the_wire(payload: int, expected: int) -> None:
    assert wire_bytes(payload) == expected


def test_opus_stays_within_the_aim(tmp_path: Path) -> None:
    shown = StringIO()
    console = Console(file=shown, width=80)
    assert run(SOUND.run_of(output=tmp_path, seconds=3.0, bitrates=[24_000], console=console)) == 0
    results = load(tmp_path / "sound.json")
    pcm, *opus = results.cells
    assert (pcm.variant, pcm.figures["ratio"]) == ("pcm", 1.0)
    assert [cell.params["packet"] for cell in opus] == ["1 part", "2 parts", "3 parts"]
    assert opus[1].percentile(50) <= AIM * pcm.percentile(50)
    assert re.search(r"opus +24 kbit/s +1 part ", shown.getvalue())
    assert str(results.aims[0]) in shown.getvalue().replace("\n", " ")
