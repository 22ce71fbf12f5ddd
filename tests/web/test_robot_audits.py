"""The audits that robots keep: who may read them on the page, and how a server notices that one was cut off."""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from playwright.sync_api import Browser

from pebble.contract import chain
from pebble.contract.chain import Mark
from pebble.fleet.audit import MAX_MARKS, Audit
from pebble.transports import Message
from tests.support import Broker, until
from tests.web.attacker import Hall
from tests.web.browser import Size, tab
from tests.web.served import RecordingRobot, Served

NAMES = itertools.count(1)


def lines(count: int) -> list[bytes]:
    found, before = [], Mark()
    for number in range(count):
        raw, before = chain.line(before, {"t": 1.0, "what": "stop", "who": "ann", "number": number})
        found.append(raw)
    return found


def state(newest: bytes) -> dict[str, Any]:
    found = chain.parse(newest)
    assert found is not None
    return {"acts": {"n": found.n, "h": found.h}, "refused": {"n": 0, "h": chain.BEGIN}, "saved": True}


@pytest.fixture
def hall(broker: Broker, tmp_path: Path) -> Iterator[Hall]:
    with Hall(broker.port, tmp_path) as one:
        yield one


class AuditedRobot(RecordingRobot):
    """Answers with the newest lines of acts that it has, each time after an answer to another reader."""

    lines: list[bytes]
    most = 50  # in one answer

    def answer(self, messages: list[Message]) -> None:
        super().answer(messages)
        for message in messages:
            if message.topic.endswith("/audit-read"):
                asked = json.loads(message.payload)
                self._answer("acts", 5)
                self._answer(asked["chain"], asked["before"])

    def _answer(self, name: str, before: int) -> None:
        known = self.lines if name == "acts" else []
        found = [raw.decode() for raw in known if not before or json.loads(raw)["n"] < before]
        self.publish("audit-lines", {"chain": name, "before": before, "lines": found[-self.most :]})


@pytest.fixture
def robot(broker: Broker) -> Iterator[AuditedRobot]:
    offered = {"system": {"available": True}, "estop": {"available": True, "owners": ["serial"]}}
    with AuditedRobot(broker.port, f"pebble/robots/audited{next(NAMES)}", capabilities=offered) as one:
        one.lines = lines(20)
        yield one


def read(served: Served, robot: AuditedRobot, before: int = 0) -> dict[str, Any]:
    query: dict[str, str | int] = {"ref": robot.base, "chain": "acts", "before": before}
    answer = httpx.get(f"{served.origin}/api/robot-audit", params=query, timeout=20)
    assert answer.status_code == 200, answer.text
    found: dict[str, Any] = answer.json()
    return found


def test_what_a_server_has_noted_shows_what_is_missing(served: Served, robot: AuditedRobot) -> None:
    with served.page() as page:
        assert page.knows(robot.base)
        robot.publish("audit", state(robot.lines[-1]), retain=True)
        assert until(lambda: read(served, robot)["noted"] == 20, 10)
        found = read(served, robot)
        assert (found["problem"], found["lines"][-1]["number"]) == ("", 19)
        robot.lines = robot.lines[10:]  # the older file was replaced
        older = read(served, robot, before=15)
        assert (older["problem"], [line["n"] for line in older["lines"]]) == ("", [11, 12, 13, 14])
        assert (read(served, robot, before=11)["problem"], read(served, robot, before=11)["lines"]) == ("", [])
        del robot.lines[3]
        assert read(served, robot, before=15)["problem"] == "lines are missing between 13 and 15"
        robot.lines = lines(20)
        robot.lines = robot.lines[:-2]
        assert read(served, robot)["problem"] == "lines 19 to 20 are missing: the end was cut off"
        robot.lines[4] = robot.lines[4].replace(b"ann", b"bob")
        assert read(served, robot)["problem"].startswith("line 5 was changed")


def test_only_who_looks_after_robots_reads_their_audit(hall: Hall) -> None:
    for name, code in (("viewer", 403), ("driver", 403), ("admin", 404), ("", 401)):
        with hall.client(name) as client:
            assert client.get("/api/robot-audit", params={"ref": "pebble/robots/none"}).status_code == code, name


def test_marks_survive_and_never_go_back(tmp_path: Path) -> None:
    for mark in (Mark(5, "a"), Mark(9, "b"), Mark(7, "c")):
        log = Audit(tmp_path / "people.sqlite")
        log.note("robot", "acts", mark)
        log.close()
    log = Audit(tmp_path / "people.sqlite")
    assert log.marks("robot", "acts")[-1] == Mark(9, "b")
    assert len(log.marks("robot", "acts")) <= MAX_MARKS
    assert log.marks("robot", "refused") == []
    log.close()


@pytest.mark.page
@pytest.mark.parametrize("size", ["desktop", "phone"])
def test_a_person_pages_through_an_audit_and_sees_that_a_line_was_changed(
    served: Served, robot: AuditedRobot, browser: Browser, size: Size
) -> None:
    robot.most = 15
    robot.publish("audit", state(robot.lines[-1]), retain=True)
    with tab(browser, f"{served.origin}/r/{robot.base}", size) as opened:

        def shows(*texts: str) -> bool:
            return opened.until(lambda: all(text in opened.test("panel-audit").inner_text() for text in texts), 20)

        rows = lambda: opened.test("audit-line").count()
        opened.uncover("audit").click()
        assert shows("Nothing was changed or taken out of these lines; this server had noted", "number 19", "number 5")
        assert rows() == 15
        opened.test("audit-older").click()
        assert shows("number 4", "number 0")
        assert (rows(), opened.test("audit-older").count()) == (5, 0)
        opened.test("audit-refused").click()
        assert shows("No lines")
        robot.lines[12] = robot.lines[12].replace(b"ann", b"bob")
        opened.test("audit-acts").click()
        assert shows("The audit was changed: line 13 was changed")
        opened.page.get_by_role("button", name="STOP: emergency stop").click()
        assert until(lambda: robot.latched, 10)
        opened.test("close-audit").click()
        assert opened.until(lambda: not opened.test("panel-audit").count())
        assert opened.complaints() == []
