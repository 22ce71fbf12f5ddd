"""A page whose database cannot be written for a while: a login says so, and driving and stops go on."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest

from pebble.extensions.page.access import login
from pebble.runtime.rate_limit import RateLimitedLog
from tests.ext.page.attacker import PASSWORDS, Hall
from tests.kit.played_robot import RecordingRobot
from tests.small_disk import SmallDisk
from tests.support import Broker, needs_root, until

pytestmark = needs_root
REF = "pebble/robots/goob"


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[SmallDisk]:
    disk = SmallDisk(tmp_path / "state")
    disk.mount()
    yield disk
    disk.close()


def test_with_a_full_disk_a_login_names_what_is_wrong_and_what_is_driven_stays_so(
    broker: Broker, disk: SmallDisk, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(login, "_log", RateLimitedLog(logging.getLogger("login")))  # it has logged nothing yet
    with (
        Hall(broker.port, disk.root, recordings=None) as hall,
        RecordingRobot(broker.port, REF) as robot,
        hall.page("driver") as page,
        hall.client("driver") as client,
    ):
        headers = {"origin": hall.served.origin}

        def log_in() -> httpx.Response:
            body = {"user": "admin", "password": PASSWORDS["admin"]}
            with hall.client() as new:
                return new.post("/api/login", json=body, headers=headers)

        assert page.knows(REF)
        assert page.ready()
        assert page.take(REF)
        with disk.full():
            assert until(lambda: log_in().status_code == 503)
            page.send("picture-from", ref=REF, source=REF)
            page.drive(REF, 1, x=0.5)
            assert until(lambda: any(one.get("x") for one in robot.drives())), page.refused
            stop = {"op": "estop", "ref": REF, "stop": "0123456789abcdef"}
            assert client.post("/api/estop", json=stop, headers=headers).status_code == 202
            assert until(lambda: robot.latched)
            assert not page.closed
            assert client.get("/").status_code == 200
        assert until(lambda: log_in().status_code == 200)
        assert until(lambda: "stop" in {entry.what for entry in hall.served.app.state.audit.read(100)})
    assert "people.sqlite: database or disk is full: nobody can log in" in caplog.text
    assert [record for record in caplog.records if record.exc_info] == []
