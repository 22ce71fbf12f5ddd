"""A gateway that is killed and hangs, while its robots are driven and stopped."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.ext.fleet.gateway_rig import GatewayProcess, Hall, hall_of
from tests.robot.operator import Driver, retained_messages
from tests.robot.rig import BASE, Rig
from tests.support import further, until

pytestmark = pytest.mark.alone
FAULT_S, SECOND_S = 2.0, 10.0
BACK_S, STOP_S = 6.0, 1.0


@pytest.fixture(scope="module")
def hall(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Hall]:
    with hall_of(tmp_path_factory.mktemp("gateways"), 6) as hall:
        yield hall


FAULTS: dict[str, tuple[Callable[[GatewayProcess], None], Callable[[GatewayProcess], None]]] = {
    "kill": (GatewayProcess.kill, GatewayProcess.start),
    "hang": (lambda gateway: gateway.signal(signal.SIGSTOP), lambda gateway: gateway.signal(signal.SIGCONT)),
}


@pytest.mark.parametrize("fault", ["kill", further("hang")])
def test_after_a_fault_its_robots_are_driven_and_stopped_again(hall: Hall, fault: str) -> None:
    begin, end = FAULTS[fault]
    begin(hall.gateway)
    time.sleep(FAULT_S)
    end(hall.gateway)
    mended = time.monotonic()
    assert until(lambda: hall.driven(mended), 30)
    assert time.monotonic() - mended <= BACK_S
    assert hall.stop() <= STOP_S
    assert hall.wrong() == 0


def test_a_second_one_does_not_start_and_takes_over_where_it_is_tried_again(hall: Hall) -> None:
    """As systemd does; and the first one finds it then."""
    second, first = hall.process("gate-2"), hall.gateway
    assert second.ends(SECOND_S) == 1
    assert "gateway gate-2 does not start: gate-1 carries pebble/robots/r" in second.printed
    assert hall.wrong() == 0
    first.kill()
    began = time.monotonic()
    second.start()
    assert until(lambda: hall.driven(began), SECOND_S)
    first.start()
    assert first.ends(SECOND_S) == 1
    second.kill()
    first.start()
    hall.wait_until_carried()
    assert hall.wrong() == 0


@pytest.mark.thorough
def test_a_whole_robot_is_driven_and_stopped_through_a_gateway_that_is_started_again(tmp_path: Path) -> None:
    with hall_of(tmp_path, 1) as hall:
        remote = {"kind": "zenoh", "connect": [f"tcp/127.0.0.1:{hall.hub_port}"]}
        with Rig("zenoh", remote=hall.broker, mqtt_bridge={"remote": remote}) as rig:
            assert {"outgoing/capabilities", "outgoing/status"} <= retained_messages(hall.broker.port, BASE).keys()
            driver = Driver(rig.operator)
            assert until(rig.mcu.turning, 10)
            began = time.monotonic()
            hall.gateway.kill()
            assert until(lambda: not rig.mcu.turning(), 2), "nothing commands it"
            hall.gateway.start()
            assert until(lambda: rig.mcu.moving(began + 0.75), 10)
            stopped = time.monotonic()
            rig.operator.send("incoming/estop", {"stop": "s" * 16, "by": "ann"})
            assert until(lambda: not rig.mcu.turning(), 1)
            assert rig.operator.wait_for("outgoing/estop/serial", since=stopped).json["latched"]
            driver.stop()
        assert hall.wrong() == 0
