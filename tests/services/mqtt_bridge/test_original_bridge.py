"""What a stop sends does not circulate through the original's bridge, beside which ours may run."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.fakes.original_bridge import OriginalBridge
from tests.robot.operator import Operator
from tests.support import Broker, until

BASE = "pebble/robots/original"
STOP, RESET, DRIVE = "incoming/estop", "incoming/estop-reset", "incoming/drive-values"
STATE = "outgoing/estop/mcu"
MIRROR_FLAG = "incoming/flags/remote-mirror"
REPETITIONS = 6
_REPEAT_S = 0.2  # a sender repeats every 0.5 s: this is harder


@pytest.fixture
def local(tmp_path: Path) -> Iterator[Broker]:
    broker = Broker(tmp_path)
    yield broker
    broker.stop()


@pytest.fixture
def remote(tmp_path: Path) -> Iterator[Broker]:
    broker = Broker(tmp_path)
    yield broker
    broker.stop()


def press(remote: Operator, local: Operator) -> None:
    """What a sender and an owner publish for one stop and its reset."""
    remote.send("incoming/autonomy-command", {"action": "stop"})
    for number in range(REPETITIONS):
        remote.send(STOP, {"stop": "00000000000000a1", "by": "test"})
        remote.send(DRIVE, {"x": 0, "z": 0, "valid_ms": 0})
        local.send(STATE, {"latched": True, "count": number}, retain=True)
        time.sleep(_REPEAT_S)
    remote.send(RESET, {"boot": "00000000", "count": 1})


def counts(operator: Operator) -> Counter[str]:
    return Counter(seen.topic.removeprefix(f"{BASE}/") for seen in operator.seen)


def at_rest(*operators: Operator) -> None:
    """Wait until nothing arrives for a second: a loop would never let this return."""
    deadline = time.monotonic() + 10
    before, since = -1, time.monotonic()
    while time.monotonic() - since < 1.0:
        now = sum(len(operator.seen) for operator in operators)
        if now != before:
            before, since = now, time.monotonic()
        assert time.monotonic() < deadline, "messages do not come to rest"
        time.sleep(0.02)


SENT = {STOP: REPETITIONS, DRIVE: REPETITIONS, STATE: REPETITIONS, RESET: 1, "incoming/autonomy-command": 1}


@pytest.mark.parametrize("mirroring", [False, True])
def test_each_message_arrives_once_on_each_of_two_brokers(local: Broker, remote: Broker, *, mirroring: bool) -> None:
    bridge = OriginalBridge(BASE, ("127.0.0.1", local.port), ("127.0.0.1", remote.port))
    program, operator = Operator(local.port, BASE), Operator(remote.port, BASE)
    operator.send(MIRROR_FLAG, b"true" if mirroring else b"false")
    program.wait_for(MIRROR_FLAG)
    press(operator, program)
    at_rest(program, operator)
    for seen in (program, operator):
        assert {metric: count for metric, count in counts(seen).items() if metric != MIRROR_FLAG} == SENT
    bridge.drop_remote()
    at_rest(program, operator)
    assert counts(program)[STOP] == counts(operator)[STOP] == REPETITIONS
    for client in (bridge, program, operator):
        client.close()


def test_each_message_arrives_once_on_one_broker(remote: Broker) -> None:
    """Which the original recognises by its address."""
    where = ("127.0.0.1", remote.port)
    bridge = OriginalBridge(BASE, where, where)
    program, operator = Operator(remote.port, BASE), Operator(remote.port, BASE)
    press(operator, program)
    at_rest(program, operator)
    assert counts(program) == counts(operator) == SENT
    for client in (bridge, program, operator):
        client.close()


def test_a_stop_below_flags_would_come_back(local: Broker, remote: Broker) -> None:
    """Why the topic is not ``incoming/flags/…``, and a sign that this stand-in can send messages back at all."""
    bridge = OriginalBridge(BASE, ("127.0.0.1", local.port), ("127.0.0.1", remote.port))
    operator = Operator(remote.port, BASE)
    flag, stops = "incoming/flags/e-stop", [b'{"stop": "%016x"}' % number for number in range(20)]
    with bridge.busy_locally():
        for stop in stops:
            operator.send(flag, stop)
        assert until(lambda: bridge.has_received(flag, stops[-1]))
    assert until(lambda: len(operator.seen) > len(stops) + 10)
    for client in (bridge, operator):
        client.close()
