"""Control of a Linux robot's motors: what its owner answers, and what reaches the line. The rules: tests/motion."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from pebble.config import Security
from pebble.contract import CONTROL_STATE, CONTROL_VOUCHED, codec
from pebble.contract.payloads import ControlRequest, ControlState
from pebble.motors.control import Control
from tests.services.serial_mcu_bridge.motor_rig import BASE, Bench
from tests.support import until

ANN, OTTO = {"id": "aaaaaaaa", "by": "ann", "device": "phone"}, {"id": "00000001", "by": "otto"}
LONGEST = "z" * 50


# -- on a clock that the test moves


def test_states_are_published_when_they_change_and_not_more_than_four_times_a_second(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.INFO)
    states: list[ControlState] = []
    control = Control(Security(), states.append, 100.0)
    control.note(100.0)
    assert [state.key for state in states] == [""]
    for number in range(1000):  # a flood of people who ask, and release
        control.request(ControlRequest(id=f"{number:08x}", by=f"mia{number}"), over=True, now=100.0)
        assert control.note(100.0)
    assert len(states) == 4
    now = 100.0
    while control.due is not None:
        now = control.due
        control.tick(now)
        control.note(now)
    assert len(states) == 6  # the newest as soon as it may be, and that control is free again
    assert states[4].by == "mia999"
    assert (states[5].key, now) == ("", pytest.approx(103.0, abs=0.3))
    control.repeat_state(now + 5)
    assert states[6:] == [control.state()] == [states[5]]
    assert caplog.messages == [f"mia{number} has control" for number in range(5)]


def test_a_state_is_short() -> None:
    states: list[ControlState] = []
    control = Control(Security(), states.append, 0.0)
    for over, name in ((True, "aaaaaaaa"), (False, "bbbbbbbb")):
        control.request(ControlRequest(id=name, by=LONGEST, device=LONGEST), over=over, now=0.0)
    control.note(0.0)
    raw = codec.encode(CONTROL_STATE, states[-1])
    assert states[-1].asks == "z" * 40
    assert len(raw) <= 300
    assert codec.decode(CONTROL_STATE, raw) == states[-1]


# -- a service, an MCU and operators


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    one = Bench(tmp_path, "goob")
    yield one
    one.close()


def held(bench: Bench, by: str) -> str:
    """The key, once this one has control."""
    assert until(lambda: bench.world.newest("control/serial").get("by") == by, 5), bench.payloads("control/serial")
    key: str = bench.world.newest("control/serial")["key"]
    return key


@pytest.mark.parametrize(
    ("owner", "latches"),
    [({"owner": "right"}, False), ({"owner": "left"}, True), ({"owner": "else"}, True), ({}, True)],
)
def test_a_stop_that_is_repeated_for_another_listed_owner_is_ignored(
    tmp_path: Path, owner: dict[str, str], *, latches: bool
) -> None:
    bench = Bench(tmp_path, "goob", instance="left", peer="right")
    try:
        assert until(lambda: bench.world.on("estop/left"), 5)
        bench.send("estop", {"stop": "a" * 16, **owner})
        bench.send("control", ANN)  # judged after it
        assert until(lambda: bench.world.newest("control/left").get("by") == "ann", 5)
        assert until(lambda: bench.world.newest("estop/left")["latched"] is latches, 5)
    finally:
        bench.close()


def test_a_drive_command_that_waited_renews_control_before_the_silence_counts(bench: Bench) -> None:
    bench.send("control", {**ANN, "for_ms": 1000})
    key, began = held(bench, "ann"), time.monotonic()
    assert until(lambda: time.monotonic() > began + 1.1)
    blocked, go_on, counters = threading.Event(), threading.Event(), bench.service.transport.counters

    def stand_still() -> None:
        blocked.set()
        go_on.wait(5)

    bench.service.post(stand_still)
    assert blocked.wait(5)
    delivered = counters["delivered"]
    bench.drive(0.5, key=key)
    vouched = b'{"from": 0, "to": %d}' % (1000 * time.monotonic())
    assert bench.operator.publish(CONTROL_VOUCHED.topic(BASE), vouched)
    assert until(lambda: counters["delivered"] == delivered + 2)
    go_on.set()
    assert bench.line("M 0.500 0.500")
