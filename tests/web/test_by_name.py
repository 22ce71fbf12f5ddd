"""The page knows its robots also where a broker sends retained messages for exact names only."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.sparing_broker import SparingBroker
from tests.support import Broker, until
from tests.tcp_proxy import TcpProxy
from tests.web.served import FREE, Page, RecordingRobot, Served

GOOB = "pebble/robots/goob"


@pytest.fixture
def robot(broker: Broker) -> Iterator[RecordingRobot]:
    with RecordingRobot(broker.port, GOOB) as one:
        one.publish("charging-level", {"value": 7.9, "unit": "V"}, retain=True)
        one.publish("estop/serial", FREE, retain=True)
        yield one


def level(page: Page) -> object:
    return (page.value(GOOB, "charging-level") or {}).get("value")


@pytest.mark.parametrize("late_s", [0.0, 2.0])
@pytest.mark.usefixtures("robot")
def test_what_was_retained_before_the_server_came(broker: Broker, late_s: float) -> None:
    sparing = SparingBroker(broker.port, by_name=True, late_s=late_s)
    with Served(sparing.port) as served, served.page() as page:
        assert until(lambda: page.value(GOOB, "web/estop", "owners"), 10)
        assert (level(page), page.value(GOOB, "web/estop", "latched")) == (7.9, False)
        assert page.ready()
        assert page.take(GOOB)
        page.send("watch", ref=GOOB)
    sparing.close()


def test_what_has_changed_during_an_outage(broker: Broker, robot: RecordingRobot) -> None:
    sparing = SparingBroker(broker.port, by_name=True)
    with TcpProxy(sparing.port) as way, Served(way.port) as served, served.page() as page:
        assert until(lambda: level(page) == 7.9, 10)
        way.cut()
        assert until(lambda: page.value("", "web/broker", "connected") is False, 10)
        robot.publish("charging-level", {"value": 7.1, "unit": "V"}, retain=True)
        robot.publish("estop/serial", FREE | {"latched": True, "count": 1}, retain=True)
        way.mend()
        assert until(lambda: (level(page), page.value(GOOB, "web/estop", "latched")) == (7.1, True), 15)
    sparing.close()
