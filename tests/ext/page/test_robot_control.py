"""Pages at real servers and a real broker, and a robot that keeps control itself: who drives, asks, lets and takes."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import Any

import pytest

from pebble.extensions.fleet.roles import Role, page_rights
from tests.ext.page.attacker import Hall
from tests.ext.page.served import Page, Served
from tests.kit.played_robot import RecordingRobot
from tests.support import until

NAMES = itertools.count(1)


@pytest.fixture
def robot(broker) -> Iterator[RecordingRobot]:
    with RecordingRobot(broker.port, f"pebble/robots/keeping{next(NAMES)}", keeps=True) as one:
        yield one


@pytest.fixture
def attic(broker) -> Iterator[Served]:
    """Another server."""
    with Served(broker.port, server="attic") as one:
        yield one


def ready(served: Served, robot: RecordingRobot, **options: Any) -> Page:
    page = served.page(**options)
    assert page.knows(robot.base)
    assert page.ready()
    return page


def view(page: Page, robot: RecordingRobot) -> dict[str, Any]:
    found: dict[str, Any] = page.value(robot.base, "web/driver")
    return found


def acts(served: Served, robot: RecordingRobot) -> list[str]:
    """What is in the audit log of one server, the first act first."""
    return [one.what for one in served.app.state.audit.read(100) if one.ref == robot.base]


def moving(robot: RecordingRobot) -> list[dict[str, Any]]:
    return [one for one in robot.drives() if one["z"]]


def test_a_page_has_control_when_the_robot_has_answered_and_its_commands_have_the_key(served, attic, robot):
    with ready(served, robot, name="Ann B.", device="phone") as page, ready(attic, robot) as there:
        assert view(page, robot)["keeps"] is True
        assert page.take(robot.base)
        assert view(page, robot)["by"] == "Ann B."
        assert until(lambda: view(there, robot)["by"] == "ann_b_")
        assert (view(there, robot)["device"], view(there, robot)["checked"]) == ("phone", False)
        page.drive(robot.base, 1, z=0.5)
        assert until(lambda: moving(robot))
        assert robot.keeping is not None
        key = robot.keeping.owners[0].lease.key
        assert moving(robot)[-1] == {"x": 0.0, "z": 0.5, "y": 0.0, "valid_ms": 400, "key": key}
        page.drive(robot.base, 1)
        assert until(lambda: robot.drives()[-1] == {"x": 0.0, "z": 0.0, "y": 0.0, "key": key})
        there.drive(robot.base, 1, z=0.9)
        assert until(lambda: there.refused)
        assert there.refused[0]["why"] == "ann_b_ is driving"
        assert {one["z"] for one in moving(robot)} == {0.5}
    assert until(lambda: robot.keeping.owners[0].by == ""), "it is given back when the page is closed"
    assert not any(topic.endswith("/driving") for topic in robot.topics())


def test_who_drives_at_another_server_is_asked_and_lets_drive(served, attic, robot):
    with ready(served, robot, name="ann") as ann, ready(attic, robot, name="otto") as otto:
        assert ann.take(robot.base)
        ann.drive(robot.base, 1, z=0.5)
        assert until(lambda: moving(robot))
        otto.send("lease", ref=robot.base, take=True)
        assert until(lambda: view(ann, robot)["asks"] == "otto" and view(otto, robot)["asking"])
        assert view(otto, robot)["you"] is False
        ann.send("lease", ref=robot.base, take=False)
        assert until(lambda: view(otto, robot)["you"] and view(ann, robot)["by"] == "otto")
        assert view(otto, robot)["asking"] is False
        otto.drive(robot.base, 1, z=0.7)
        assert until(lambda: moving(robot)[-1]["z"] == 0.7)
        assert moving(robot)[-1]["key"] != moving(robot)[0]["key"]
        ann.drive(robot.base, 2, z=0.9)
        assert until(lambda: ann.refused)
        assert all(one["z"] != 0.9 for one in moving(robot))
        assert until(lambda: acts(served, robot) == ["take", "drive", "release"], 5)
        assert until(lambda: acts(attic, robot)[:2] == ["ask", "take"], 5)


def test_only_who_has_the_right_takes_over(broker, robot, tmp_path):
    with Hall(broker.port, tmp_path) as hall, hall.page("admin") as admin:
        assert admin.knows(robot.base)
        assert admin.take(robot.base)
        for role in Role:
            with hall.page(role.value) as page:
                assert page.knows(robot.base)
                page.send("lease", ref=robot.base, take=True, over=True)
                may = "take" in page_rights(role)
                assert until(lambda page=page, may=may: view(page, robot)["you"] if may else page.refused), role
