"""Two page servers with accounts of their own, a real broker, and a robot that takes commands only with names."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import Any

import pytest

from pebble.extensions.fleet.roles import Role
from pebble.transports import MqttSettings
from tests.ext.page.attacker import Hall
from tests.ext.page.served import Served
from tests.kit.played_robot import RecordingRobot
from tests.support import Broker, until

NAMES = itertools.count(1)


def server(broker: Broker, account: str | None) -> Served:
    return Served(broker.port, server="hall", broker=MqttSettings(host="127.0.0.1", port=broker.port, username=account))


@pytest.fixture
def robot(broker: Broker) -> Iterator[RecordingRobot]:
    with RecordingRobot(broker.port, f"pebble/robots/named{next(NAMES)}", keeps=True, named=True) as one:
        yield one


def names(robot: RecordingRobot, metric: str) -> list[Any]:
    """Who has sent each message of this metric."""
    topic = f"{robot.base}/incoming/{metric}"
    return [one.get("by", "") for _, name, one in list(robot.received) if name == topic]


def test_everything_has_the_servers_account_in_its_topic_and_the_person_beside_it(broker, robot):
    ref = robot.base
    with server(broker, "page-1") as hall, hall.page(name="ann") as page:
        assert page.knows(ref)
        assert page.ready()
        assert page.take(ref)
        assert page.value(ref, "web/driver", "checked") is True
        page.drive(ref, 1, z=0.5)
        page.send("lights", ref=ref, r=1.0, n=1)
        page.send("autonomy", ref=ref, file="", n=2)
        page.send("flag", ref=ref, name="mqtt-video", on=True, n=3)
        page.send("estop", ref=ref, stop="00c0ffee00c0ffee", why="")
        assert until(lambda: page.value(ref, "web/estop", "latched") is True)
        owners = [{"owner": "serial", "boot": "00000000", "count": 1}]
        page.send("estop-reset", ref=ref, owners=owners)
        assert until(lambda: page.value(ref, "web/estop", "latched") is False)
        for metric in ("control", "drive-values", "lights-solid", "autonomy-command", "estop-reset"):
            assert until(lambda metric=metric: names(robot, metric)), metric
            assert set(names(robot, metric)) <= {"page-1/ann", "page-1"}, metric
            assert "page-1/ann" in names(robot, metric), metric
        by_name = f"{ref}/incoming/by/page-1/"
        assert until(lambda: f"{by_name}flags/mqtt-video" in robot.wire)
        assert {f"{ref}/incoming/estop", f"{by_name}estop"} <= robot.wire
        assert {one for one in robot.wire if not one.startswith(by_name)} == {f"{ref}/incoming/estop"}


def test_a_server_without_an_account_stops_and_else_shows_why_it_may_do_nothing(broker, robot):
    ref = robot.base
    with server(broker, None) as hall, hall.page() as page:
        assert page.knows(ref)
        assert page.ready()
        page.send("lease", ref=ref, take=True)
        page.send("lights", ref=ref, r=1.0, n=1)
        assert until(lambda: len(page.refused) == 2)
        assert {one["why"].partition(",")[0] for one in page.refused} == {f"{ref[14:]} takes commands only with a name"}
        page.send("stop", ref=ref)
        page.send("estop", ref=ref, stop="00c0ffee00c0ffee", why="")
        assert until(lambda: page.value(ref, "web/estop", "sending") == "confirmed")
        assert robot.wire == {f"{ref}/incoming/drive-values", f"{ref}/incoming/estop"}


def test_a_robot_that_checks_names_is_reset_only_by_safety_and_admin(broker, robot, tmp_path):
    ref, account = robot.base, MqttSettings(host="127.0.0.1", port=broker.port, username="page-1")
    with Hall(broker.port, tmp_path, broker=account) as hall:
        for number, role in enumerate(Role, 1):
            with hall.page(role.value) as page:
                assert page.knows(ref)
                page.send("estop", ref=ref, stop=f"{number:016x}", why="")
                assert until(
                    lambda page=page, number=number: (
                        [one["count"] for one in page.value(ref, "web/estop", "owners")] == [number]
                    )
                )
                page.send("estop-reset", ref=ref, owners=[{"owner": "serial", "boot": "00000000", "count": number}])
                page.send("flag", ref="pebble/robots/nowhere", name="mqtt-video", on=True, n=1)
                assert until(lambda page=page: page.refused)
                assert ("reset" in page.welcome["named_rights"]) is (role in (Role.SAFETY, Role.ADMIN))
                refused = "estop-reset" in [one["cmd"] for one in page.refused]
                assert refused is ("reset" not in page.welcome["named_rights"])
    assert until(lambda: set(names(robot, "estop-reset")) == {"page-1/safety", "page-1/admin"})
