"""The silence of a board that reports at rest means something; that of others does not."""

from __future__ import annotations

import pytest

from pebble.services.serial_mcu_bridge.line.serial_line import LineState
from pebble.services.serial_mcu_bridge.line.silence import Silence

#: Per second: r received at rest, d received while it was driven, . nothing, o opened again, x the device has gone.
CASES = {
    "never heard": ("." * 30, "ready", None),
    "Goob and Fred, who report at rest": ("r" * 30, "ready", 0),
    "a pause": ("rrrrrr...", "ready", 1000),
    "it hangs": ("rrrrr..........", "silent", 10_000),
    "it sends again": ("rrrrr..........r", "ready", 0),
    "heard once, at its start": ("r" + "." * 30, "ready", 10_000),
    "a start of four seconds": ("rrrr" + "." * 30, "ready", 10_000),
    "it answers to commands only": ("d" * 30 + "." * 30, "ready", 10_000),
    "it reports its battery every 3 s": ("r.." * 10 + "." * 10, "ready", 10_000),
    "regular, driven, then dead": ("rrrrr" + "d" * 9 + "." * 10, "silent", 10_000),
    "opened again, not heard": ("rrrrro" + "." * 20, "ready", None),
    "opened again, heard": ("rrrrror", "ready", 0),
    "gone": ("rrrrrx", "absent", None),
}


@pytest.mark.parametrize(("seconds", "state", "silent_ms"), CASES.values(), ids=CASES)
def test_silence(seconds: str, state: str, silent_ms: int | None) -> None:
    silence, opened, received, found = Silence(), 1, 0, ("", None)
    for now, second in enumerate(seconds, start=100):
        opened += second == "o"
        received = 0 if second == "o" else received + 20 * (second in "rd")
        line = LineState.ABSENT if second == "x" else LineState.READY
        found = silence.check(line, opened, received, float(now), idle=second != "d")
    assert found == (state, silent_ms)
