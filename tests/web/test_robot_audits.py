"""The audits that robots keep: who may read them on the page, and how a server notices that one was cut off."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from pebble.contract import chain
from pebble.contract.chain import Mark
from pebble.fleet.audit import MAX_MARKS, Audit
from pebble.transports import Message
from tests.support import Broker, until
from tests.web.attacker import Hall
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
    """Answers with the lines that it has."""

    lines: list[bytes]

    def answer(self, messages: list[Message]) -> None:
        super().answer(messages)
        for message in messages:
            if message.topic.endswith("/audit-read"):
                self.publish("audit-lines", {"chain": "acts", "lines": [raw.decode() for raw in self.lines]})


@pytest.fixture
def robot(broker: Broker) -> Iterator[AuditedRobot]:
    with AuditedRobot(broker.port, f"pebble/robots/audited{next(NAMES)}") as one:
        one.lines = lines(20)
        yield one


def read(served: Served, robot: AuditedRobot) -> dict[str, Any]:
    answer = httpx.get(f"{served.origin}/api/robot-audit", params={"ref": robot.base, "chain": "acts"}, timeout=20)
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
