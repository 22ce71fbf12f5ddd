"""The motor bridge at a broker that refuses some of its subscriptions."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from pebble.transports import Message, MqttSettings, QoS, State, create
from tests.services.serial_mcu_bridge.motor_rig import BASE, STOP, STOPPED, Bench
from tests.support import RefusingBroker, errors, until

ESTOP, ESTOP_RESET = (f"{BASE}/incoming/{metric}" for metric in ("estop", "estop-reset"))


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[RefusingBroker]:
    broker = RefusingBroker(tmp_path)
    yield broker
    broker.stop()


@pytest.fixture
def start(broker: RefusingBroker, tmp_path: Path) -> Iterator[Callable[[], Bench]]:
    """Its commands are valid for longer than the tests take."""
    made: list[Bench] = []

    def make() -> Bench:
        made.append(Bench(tmp_path, "goob", broker=broker, safety={"drive_timeout_seconds": 5}))
        assert until(lambda: made[0].service.transport.state is State.CONNECTED)
        return made[0]

    yield make
    for bench in made:
        bench.close()


def refuse(broker: RefusingBroker, bench: Bench, *filters: str) -> None:
    clients = (bench.operator, bench.service.transport)
    before = [client.counters["connected"] for client in clients]
    broker.refuse(*filters)
    assert until(lambda: all(client.counters["connected"] > n for client, n in zip(clients, before, strict=True)))


def retained(broker: RefusingBroker) -> list[Any]:
    """The states that a new client receives."""
    found: list[Message] = []
    with create("mqtt", "observer", MqttSettings(host="127.0.0.1", port=broker.port)) as client:
        client.subscribe(f"{BASE}/outgoing/estop/+", found.append, direct=True)
    return [json.loads(message.payload) for message in found if message.payload]


def test_without_both_subscriptions_there_is_no_emergency_stop(
    broker: RefusingBroker, start: Callable[[], Bench], caplog: pytest.LogCaptureFixture
) -> None:
    broker.refuse(ESTOP)
    bench = start()
    assert until(lambda: errors(caplog))
    assert until(lambda: retained(broker) == [], step=0.1)
    old = f"{BASE}/outgoing/estop/serial"  # as a broker has it that was restored from an older save
    assert bench.operator.publish(old, b'{"latched": false}', qos=QoS.DELIVERED, retain=True)
    assert until(lambda: b'{"latched": false}' in [message.payload for message in bench.world.received])
    bench.service.post(bench.service.repeat_state)
    assert until(lambda: retained(broker) == [], step=0.1)
    (error,) = errors(caplog)
    assert f"refuses the subscription to {ESTOP}: this robot has no emergency stop" in error
    assert f"to subscribe to both {ESTOP} and {ESTOP_RESET}" in error
    assert bench.moves(0.5)


def test_a_stop_that_could_not_be_reset_is_a_final_zero(broker: RefusingBroker, start: Callable[[], Bench]) -> None:
    broker.refuse(ESTOP_RESET)
    bench = start()
    bench.send("drive-values", {"z": 0.125, "source": "autonomy", "run": 7})
    assert bench.moves(0.5)
    bench.send("estop", STOP)
    assert until(lambda: bench.lines[-1] == STOPPED)
    assert bench.moves(0.25)
    refuse(broker, bench)
    assert until(lambda: retained(broker), step=0.1)
    (granted,) = retained(broker)
    assert (granted["latched"], granted["count"], granted["recent"], granted["barred"]) == (False, 0, [], 7)


def test_a_stop_from_before_the_refusal_stays_and_is_back_when_all_is_granted(
    broker: RefusingBroker, start: Callable[[], Bench], caplog: pytest.LogCaptureFixture
) -> None:
    bench = start()
    bench.send("estop", STOP)
    assert bench.stopped()
    before = bench.state
    refuse(broker, bench, ESTOP)
    assert until(lambda: errors(caplog))
    assert "it stays stopped now" in errors(caplog)[0]
    assert until(lambda: retained(broker) == [], step=0.1)
    bench.drive(0.25)
    assert until(lambda: bench.service.counters["latched"] == 1)
    assert "M 0.250 0.250" not in bench.lines
    refuse(broker, bench)
    assert until(lambda: retained(broker) == [before], step=0.1)
    assert bench.reset()
    bench.send("drive-values", {})
    assert bench.moves(0.125)
