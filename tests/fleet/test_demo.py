"""The demo of two robots that hear each other, as a user starts it: make demo FLEET=1."""

from __future__ import annotations

import re
import signal
import sys
from pathlib import Path

import pytest

from tests.kit.demo import START_S, Demo, demos, temporary
from tests.support import until

__all__ = ["demos", "temporary"]

pytestmark = [pytest.mark.alone, pytest.mark.thorough]

LONGEST_S = 240.0
STEPS_BEGIN = "the page shows goob and fred"
STEPS = (
    "the page drives fred, and goob follows",
    "a person at the LAN drives fred, and goob follows without the broker",
    "goob stood after",
    "fred stood after",
    "the page drives fred again, and goob follows",
)


def test_goob_follows_fred_without_the_broker_and_is_stopped_there(demos: list[Demo], temporary: Path) -> None:
    demos.append(demo := Demo(temporary, f"from pebble.demo.fleet import run; import sys; sys.exit(run({LONGEST_S}))"))
    code = demo.process.wait(START_S + LONGEST_S)
    sys.stdout.write(f"\n{demo.output}")
    assert code == 0, demo.output
    seen = [step for step in STEPS if step in demo.output]
    assert seen == list(STEPS)
    assert len(re.findall(r"[1-9]\d* arrived, none twice", demo.output)) == 2
    assert demo.leftovers() == []
    assert demo.folders() == []


def test_what_was_not_seen_in_time_is_a_failure_with_a_place_to_look(demos: list[Demo], temporary: Path) -> None:
    demos.append(demo := Demo(temporary, "from pebble.demo.fleet import run; import sys; sys.exit(run(1.0))"))
    assert demo.process.wait(START_S) == 1
    (folder,) = demo.folders()
    assert demo.output.splitlines()[-1].startswith("Failed: not seen: ")
    assert f"Logs, configs and traces: {folder}" in demo.output
    assert demo.leftovers() == []


def test_ctrl_c_in_the_middle_is_an_end_and_no_failure(demos: list[Demo], temporary: Path) -> None:
    demos.append(demo := Demo(temporary, "from pebble.demo.fleet import run; import sys; sys.exit(run())"))
    assert until(lambda: STEPS_BEGIN in demo.output, START_S), demo.output
    demo.process.send_signal(signal.SIGINT)
    assert demo.process.wait(START_S) == 0, demo.output
    assert demo.output.endswith("Ended before every step was seen.\n")
    assert (demo.leftovers(), demo.folders()) == ([], [])
