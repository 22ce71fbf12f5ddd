"""What sound costs on the wire."""

from __future__ import annotations

import json
from io import StringIO
from pathlib import Path

import pytest
from rich.console import Console

from pebble.bench.sound import AIM, run, wire_bytes
from pebble.errors import PebbleError


@pytest.mark.parametrize(
    ("payload", "expected"),
    [(664, 52 + 3 + 2 + 33 + 664), (80, 52 + 2 + 2 + 33 + 80), (92, 52 + 2 + 127), (93, 52 + 3 + 128)],
)
def test_a_publish_on_the_wire(payload: int, expected: int) -> None:
    assert wire_bytes(payload) == expected


def test_opus_stays_within_the_aim(tmp_path: Path) -> None:
    shown = StringIO()
    file = tmp_path / "sound.json"
    assert run(file, 3.0, bitrates=(24_000,), console=Console(file=shown, width=140)) == 0
    pcm, *opus = json.loads(file.read_text())["rows"]
    assert (pcm["variant"], pcm["ratio"], pcm["likeness"]) == ("pcm", 1.0, pytest.approx(1.0))
    assert [row["params"]["bundle"] for row in opus] == [1, 2, 3]
    assert opus[1]["ratio"] <= AIM
    assert min(row["likeness"] for row in opus) > 0.9
    assert "opus 24 kbit/s" in shown.getvalue()


def test_a_moment_is_too_short() -> None:
    with pytest.raises(PebbleError, match="1 at least"):
        run(seconds=0.5)
