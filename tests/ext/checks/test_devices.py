"""The doctor's findings of a machine: its devices, recorder, unit, slot, disk, battery, and the page's certificate."""

from __future__ import annotations

import json
import os
import ssl
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

from pebble.check_result import CheckResult, State
from pebble.config import parse
from pebble.extensions.checks.devices import camera, cameras, device, loudspeaker, microphone, serial_port
from pebble.extensions.checks.running import checks, machine
from pebble.extensions.checks.running.robot import RobotUnderTest
from pebble.extensions.fleet import authority, certificates
from pebble.extensions.operator.client.robot_view import RobotView
from pebble.extensions.operator.places import Places
from pebble.extensions.recordings.recorder.folder import Folder
from pebble.services.recorder.checks import checks as recorder
from tests.ext.recordings.playing import GOOB, Line, js, ms, write
from tests.support import free_port

KEY = "a.b"


@pytest.mark.parametrize(
    ("name", "links", "better"),
    [
        ("ttyUSB12", {"by-id/usb-1a86_USB_Serial-if00-port0": "ttyUSB12"}, "by-id/usb-1a86_USB_Serial-if00-port0"),
        ("video0", {"by-id/usb-cam-video-index0": "video0"}, "by-id/usb-cam-video-index0"),
        ("ttyACM1", {"by-id/usb-a": "ttyACM0", "by-id/usb-b": "ttyACM1"}, "by-id/usb-b"),
        # Two adapters without a serial number have one id: the other one is found by where it is plugged in.
        ("ttyUSB0", {"by-id/usb-same": "ttyUSB1", "by-path/usb-0:1.2": "ttyUSB0"}, "by-path/usb-0:1.2"),
        ("ttyACM0", {"by-id/usb-gone": "ttyACM7"}, ""),
        ("ttyAMA0", {"by-id/usb-board": "ttyAMA0"}, ""),  # a port of the computer itself: its number stays
        ("goob", {"by-id/usb-board": "goob"}, ""),  # a name that its owner gave it
    ],
)
def test_a_number_that_may_change(tmp_path: Path, name: str, links: dict[str, str], better: str) -> None:
    for place in range(13):
        for kind in ("ttyACM", "ttyUSB", "video"):
            (tmp_path / f"{kind}{place}").touch()
    (tmp_path / name).touch()
    (tmp_path / "ttyACM7").unlink()
    for link, target in links.items():
        path = tmp_path / "serial" / link
        path.parent.mkdir(parents=True, exist_ok=True)
        path.symlink_to(tmp_path / target)
    result = device(tmp_path / name, "it", KEY, tmp_path / "serial")
    assert result.state is (State.WARN if better else State.OK)
    assert result.fix == (f"set {KEY} to {tmp_path / 'serial' / better}" if better else "")


@pytest.mark.parametrize(
    ("place", "boards", "usable", "state", "text", "fix"),
    [
        ("gone", "", True, State.FAILED, "is the MCU plugged in?", "plug it in, then: ls DIR/by-id/*; and set a.b"),
        ("gone", "x", True, State.FAILED, "is the MCU plugged in?", "set a.b to DIR/by-id/x"),
        ("gone", "yx", True, State.FAILED, "is the MCU plugged in?", "set a.b to DIR/by-id/x or DIR/by-id/y"),
        ("file", "x", True, State.FAILED, "is not a device", f"correct {KEY}"),
        ("tty", "x", True, State.OK, "readable and writable", ""),
        ("tty", "x", False, State.FAILED, "only be used by its owner", "sudo usermod -aG $(stat -c %G /"),
    ],
)
def test_serial_port(
    place: str,
    boards: str,
    usable: bool,
    state: State,
    text: str,
    fix: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    names = tmp_path / "serial"
    (names / "by-id").mkdir(parents=True)
    for board in boards:
        (names / "by-id" / board).touch()
    (tmp_path / "file").touch()
    (tmp_path / "tty").symlink_to(os.ttyname(os.openpty()[1]))
    monkeypatch.setattr(os, "access", lambda *_: usable)
    result = serial_port(tmp_path / place, KEY, names)
    assert (result.state, text in result.text) == (state, True)
    assert result.fix.startswith(fix.replace("DIR", str(names)))


CAMERA = {"enabled": True, "video": {"device": "0"}}
NO_CAMERA = (State.FAILED, "video0 does not exist", "plug it in, then: ls ")
NO_MICROPHONE = (State.FAILED, "arecord is not installed", "sudo apt install alsa-utils")
#: The services of a robot, the programs of its machine, whether there is a camera, and what is found.
MEDIA: list[tuple[dict[str, Any], list[str], bool, list[tuple[State, str, str]]]] = [
    ({"av_daemon": {"enabled": False}}, [], False, []),
    (
        {"av_daemon": CAMERA},
        ["arecord", "aplay"],
        True,
        [(State.OK, "video0 readable", ""), (State.OK, "uses arecord", ""), (State.OK, "uses aplay", "")],
    ),
    (
        {"av_daemon": CAMERA},
        [],
        False,
        [NO_CAMERA, NO_MICROPHONE, (State.WARN, "aplay is not installed", "sudo apt install alsa-utils")],
    ),
    *(
        ({"soundboard_handler": {"enabled": True, "playback": {"player_command": [player]}}}, ["sh"], False, [result])
        for player, result in (
            ("/no/such/player", (State.WARN, "is not installed", "install /no/such/player, or name another")),
            ("sh", (State.OK, "uses sh", "")),
        )
    ),
]


@pytest.mark.parametrize(("services", "programs", "plugged_in", "expected"), MEDIA)
def test_camera_microphone_and_loudspeaker(
    services: dict[str, Any],
    programs: list[str],
    plugged_in: bool,
    expected: list[tuple[State, str, str]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    for name in (*programs, *["video0"] * plugged_in):
        (tmp_path / name).touch(0o755)
    config = parse({"robot": {"id": "rover"}, "services": services}, folder=tmp_path, env={})
    results = [*cameras(config, tmp_path), *microphone(config), *loudspeaker(config)]
    assert [result.state for result in results] == [state for state, _, _ in expected]
    for result, (_, text, fix) in zip(results, expected, strict=True):
        assert text in result.text
        assert result.fix.startswith(fix)


@pytest.mark.parametrize(("backend", "state"), [("synthetic", State.OK), ("libcamera", State.FAILED)])
def test_other_cameras(backend: str, state: State, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    assert camera(backend, "", tmp_path).state is state
    (tmp_path / "rpicam-vid").touch(0o755)
    assert camera(backend, "", tmp_path).state is State.OK


HOUR = "2023/11/14/20231114T221320Z-000001.state.mcap"


def findings(folder: Path, *, enabled: bool = True) -> list[CheckResult]:
    robot = {"system": "pebble", "type": "robots", "id": "goob"}
    config = {"robot": robot, "services": {"recorder": {"enabled": enabled, "folder": str(folder)}}}
    return list(recorder(parse(config, folder=folder, env={})))


def recorded(folder: Path) -> Path:
    """A finished file."""
    path = folder / HOUR
    path.parent.mkdir(parents=True, exist_ok=True)
    write(path, [Line(at, f"{GOOB}/outgoing/online", js(t=ms(at))) for at in (0.0, 900.0)])
    return path


def test_one_that_has_not_recorded_and_one_that_does_not_run(tmp_path: Path) -> None:
    (finding,) = findings(tmp_path / "none")
    assert (finding.state, "has not recorded anything" in finding.text) == (State.OK, True)
    recorded(tmp_path)
    assert findings(tmp_path)[0].text == "does not run now"


@pytest.mark.parametrize(
    ("status", "state", "text"),
    [
        ({}, State.OK, "runs, 7 messages into "),
        ({"at": 1_700_000_000.0}, State.WARN, "has stood still for "),
        ({"blocked": "no room"}, State.FAILED, "writes nothing: no room"),
        ({"dropped": 12}, State.WARN, "has dropped 12 messages"),
    ],
)
def test_one_that_runs(tmp_path: Path, status: dict[str, Any], state: State, text: str) -> None:
    with Folder(tmp_path).taken():
        (tmp_path / "recorder.json").write_text(json.dumps({"at": time.time(), "messages": 7, **status}))
        finding = findings(tmp_path)[0]
    assert (finding.state, text in finding.text) == (state, True)


@pytest.mark.parametrize(
    ("end", "fix"), [("active", "pebble recordings mend {}"), ("damaged", "pebble recordings rm FILE deletes one")]
)
def test_files_that_were_left(tmp_path: Path, end: str, fix: str) -> None:
    path = recorded(tmp_path)
    path.rename(path.with_name(f"{path.name}.{end}"))
    finding, *_ = [finding for finding in findings(tmp_path) if finding.state is State.WARN]
    assert finding.fix == fix.format(tmp_path)


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


#: Blocks of 1 MB, those that are free, free files, flags.
DISKS = [
    (10_000, 5000, 9, 0, "ok", "5.2 of 10.5 GB are free"),
    (10_000, 100, 9, 0, "failed", "0.1 of 10.5 GB are free"),
    (10_000, 5000, 0, 0, "failed", "no file can be made any more"),
    (10_000, 5000, 9, os.ST_RDONLY, "failed", "is read-only: no stop survives a power cut"),
    (0, 0, 9, 0, "ok", "0.0 of 0.0 GB are free"),
]


@pytest.mark.parametrize(("size", "free", "files", "flags", "state", "text"), DISKS)
def test_the_disk(
    size: int, free: int, files: int, flags: int, state: str, text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = os.statvfs_result((1 << 20, 1 << 20, size, free, free, 100, files, files, flags, 255))
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
