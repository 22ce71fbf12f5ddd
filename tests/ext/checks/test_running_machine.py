"""What ``pebble doctor --running`` finds of the machine: unit, slot, disk, and the page with its certificate."""

from __future__ import annotations

import os
import ssl
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

from pebble.check_result import CheckResult
from pebble.config import parse
from pebble.extensions.checks.running import checks, machine
from pebble.extensions.checks.running.robot import RobotUnderTest
from pebble.extensions.fleet import authority, certificates
from pebble.extensions.operator.client.robot_view import RobotView
from pebble.extensions.operator.places import Places
from tests.support import free_port

RUNS = {"LoadState": "loaded", "ActiveState": "active", "SubState": "running", "UnitFileState": "enabled"}
UNITS: list[tuple[Mapping[str, str], str, str]] = [
    (RUNS | {"NRestarts": "3"}, "ok", "restarted 3 times"),
    (RUNS | {"UnitFileState": "disabled"}, "failed", "does not start with the machine: disabled"),
    (
        RUNS | {"ActiveState": "failed", "SubState": "failed", "Result": "watchdog"},
        "failed",
        "failed (failed, watchdog)",
    ),
    (RUNS | {"ActiveState": "inactive", "SubState": "dead", "Result": "success"}, "failed", "is inactive (dead)"),
    ({"LoadState": "not-found"}, "skipped", "is not installed"),
]


def judged(outcome: CheckResult, state: str, text: str) -> None:
    assert (outcome.state.value, text in outcome.text) == (state, True), outcome
    assert bool(outcome.fix) is (state in ("warn", "failed"))


@pytest.mark.parametrize(("properties", "state", "text"), UNITS)
def test_the_unit(properties: Mapping[str, str], state: str, text: str) -> None:
    judged(machine.unit_of(properties), state, text)


def under_test(folder: Path, **more: Any) -> RobotUnderTest:
    raw = {"robot": {"id": "goob"}, "transport": {"kind": "zenoh", "state_dir": str(folder)}, **more}
    config = parse(raw, folder=folder, env={})
    return RobotUnderTest(config=config, places=Places(folder), by="ann", patience_s=1, rests_s=1)


#: What is there of slots ``a`` and ``b``: the links ``active`` and ``current``, whole ones, and a trial.
SLOTS: list[tuple[str, str, str, bool, str, str]] = [
    ("", "", "", False, "skipped", "not installed in slots"),
    ("a", "", "a", False, "failed", "no slot was chosen"),
    ("a", "a", "a", False, "ok", "slot a runs"),
    ("a", "a", "b", False, "failed", "slot a is not whole"),
    ("a", "b", "ab", True, "ok", "slot b is on trial, a is the active one"),
    ("a", "b", "ab", False, "failed", "slot b runs, but a is active"),
]


@pytest.mark.parametrize(("active", "current", "whole", "trial", "state", "text"), SLOTS)
def test_the_slot(active: str, current: str, whole: str, trial: bool, state: str, text: str, tmp_path: Path) -> None:
    places = Places(tmp_path)
    for name in "ab":
        (places.slots / name).mkdir(parents=True)
    for name in whole:
        (places.slots / name / ".complete").touch()
    for link, target in ((places.slots / "active", active), (places.current_slot, current)):
        link.parent.mkdir(parents=True, exist_ok=True)
        link.symlink_to(places.slots / target) if target else None
    places.slot_state.mkdir(parents=True)
    (places.slot_state / "trial").write_text("b 2 0.3.0 9f2c61d07be45a18\n") if trial else None
    judged(machine.slot(under_test(tmp_path)), state, text)


#: Free blocks of 1 MB among 10,000, free files, flags.
DISKS = [
    (5000, 9, 0, "ok", "5.2 of 10.5 GB are free"),
    (100, 9, 0, "failed", "0.1 of 10.5 GB are free"),
    (5000, 0, 0, "failed", "no file can be made any more"),
    (5000, 9, os.ST_RDONLY, "failed", "is read-only: no stop survives a power cut"),
]


@pytest.mark.parametrize(("free", "files", "flags", "state", "text"), DISKS)
def test_the_disk(
    free: int, files: int, flags: int, state: str, text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = os.statvfs_result((1 << 20, 1 << 20, 10_000, free, free, 100, files, files, flags, 255))
    monkeypatch.setattr(os, "statvfs", lambda _: found)
    judged(machine.disk(under_test(tmp_path)), state, text)


BATTERIES = [
    (7.48, 2, False, "ok", "7.48 V"),
    (7.47, 2, False, "warn", "7.47 V, 3.73 V a cell: it is below 20 %"),
    (6.8, 2, False, "warn", "6.80 V, 3.40 V a cell: it is below 20 %"),
    (6.79, 2, False, "failed", "6.79 V, 3.40 V a cell: it is nearly empty"),
    (6.79, 2, True, "ok", "6.79 V, on the charger"),
    (6.79, None, False, "ok", "6.79 V"),
    (None, 2, False, "skipped", "it reports no voltage"),
]


@pytest.mark.parametrize(("volts", "cells", "charging", "state", "text"), BATTERIES)
def test_the_battery(
    volts: float | None, cells: int | None, charging: bool, state: str, text: str, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.setattr(checks, "_VOLTS_S", 0.0)
    monkeypatch.setattr(checks, "_LOW_S", 0.0)
    robot = under_test(tmp_path, robot={"id": "goob", "battery_cells": cells})
    view = RobotView(robot.config.base)
    view.volts, view.charging = volts, charging
    robot.own = Mock(view=view)
    judged(checks.battery(robot), state, text)


@contextmanager
def served(certificate: Path, status: int = 200) -> Iterator[int]:
    """A page at a port of this machine."""

    class Page(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(status)
            self.end_headers()

        def log_message(self, *_: object) -> None:
            """Nothing."""

    server = HTTPServer(("127.0.0.1", free_port()), Page)
    context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
    context.load_cert_chain(certificate, certificate.with_suffix(".key"))
    server.socket = context.wrap_socket(server.socket, server_side=True)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        yield server.server_address[1]
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


PAGES = [
    (397, 200, True, "ok", "its certificate is valid for 39"),
    (3, 200, True, "failed", "its certificate ends in 3 days"),
    (0, 200, True, "failed", "certificate has expired"),
    (397, 200, False, "failed", "shows another certificate, or one that ended"),
    (397, 500, True, "failed", "answers 500"),
]


@pytest.mark.parametrize(("days", "status", "same", "state", "text"), PAGES)
def test_the_page(
    days: int, status: int, same: bool, state: str, text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """``same``: whether it shows the certificate of the config."""
    monkeypatch.setattr(authority, "SERVER_DAYS", days)
    for name in ("here", "there"):
        certificates.init(tmp_path / name, ["127.0.0.1"])
    shown = tmp_path / "here" / "server.pem"
    with served(shown, status) as port:
        judged(
            machine.page(_with_page(tmp_path, shown if same else tmp_path / "there" / "server.pem", port)), state, text
        )
    judged(machine.page(_with_page(tmp_path, shown, free_port())), "failed", "does not answer")


def _with_page(folder: Path, certificate: Path, port: int) -> RobotUnderTest:
    tls = {"certificate": str(certificate), "key": str(certificate.with_suffix(".key"))}
    web = {"port": port, "tls": tls, "mqtt": {"host": "127.0.0.1"}}
    return under_test(folder, web_interface=web, services={"web_handler": {"enabled": True}})
