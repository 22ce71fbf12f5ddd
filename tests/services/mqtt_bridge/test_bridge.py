"""The bridge between two transports in memory, with their threads: urgent stops."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from functools import partial
from typing import Any

import pytest

from pebble.forwarding.routing import Side
from pebble.transports import Message, QoS
from pebble.transports.memory import MemoryTransport
from tests.services.mqtt_bridge.bridge_rig import BASE, MemoryRig
from tests.support import WAIT_S, until

STOP, STATE = "incoming/estop", "outgoing/estop/mcu"
MIRROR_FLAG = "incoming/flags/remote-mirror"
PRESS, TRUE = b'{"stop": "00000000000000a1", "by": "test"}', b"true"


@pytest.fixture
def rig(monkeypatch: pytest.MonkeyPatch) -> Iterator[MemoryRig]:
    rig = MemoryRig(monkeypatch)
    yield rig
    rig.close()


class TestHeartbeat:
    def test_a_stop_on_sight_of_the_first_one_reaches_the_robot(self, rig: MemoryRig) -> None:
        """So a robot is not announced before it receives commands."""
        stops = iter([PRESS])

        def press(_: Message) -> None:
            for stop in stops:
                rig.remote.publish(STOP, stop)

        rig.remote.transport.subscribe(f"{BASE}/outgoing/online", press)
        rig.bridge()
        assert until(lambda: PRESS in rig.local.payloads(STOP))


class TestUrgency:
    def test_a_stop_is_published_by_the_thread_that_received_it(
        self, rig: MemoryRig, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """No queue and no other thread is in between, so nothing can delay it or take its place."""
        rig.bridge()
        threads: list[str] = []
        publish = MemoryTransport.publish

        def record(transport: MemoryTransport, topic: str, *arguments: Any, **options: Any) -> bool:
            if topic.endswith(STOP) and transport is rig.robot_side:
                threads.append(threading.current_thread().name)
                assert options["urgent"]
                assert options["qos"] is QoS.DELIVERED
            return publish(transport, topic, *arguments, **options)

        monkeypatch.setattr(MemoryTransport, "publish", record)
        rig.remote.publish(STOP, PRESS, qos=0)
        assert until(lambda: rig.local.on(STOP))
        assert threads == ["pebble-memory remote-bridge"]

    @pytest.mark.parametrize("retain", [False, True])
    def test_it_waits_for_no_lock_of_retained_messages(self, rig: MemoryRig, *, retain: bool) -> None:
        bridge = rig.bridge()
        held, over = threading.Event(), threading.Event()

        def hold(_topic: str) -> bool:
            held.set()
            return over.wait(WAIT_S)

        holding = partial(bridge.forwarder.retained.remove, Side.REMOTE, f"{BASE}/{STATE}", unless=hold)
        threading.Thread(target=holding, daemon=True).start()
        assert held.wait(WAIT_S)
        rig.remote.publish(STOP, PRESS, retain=retain)
        rig.remote.publish(MIRROR_FLAG, TRUE, retain=True)
        assert until(lambda: rig.local.payloads(STOP) == [PRESS])
        assert not rig.local.on(MIRROR_FLAG)
        over.set()
        assert until(lambda: rig.local.on(MIRROR_FLAG))
