"""Serial ports, camera, microphone and loudspeaker: what is missing, what is recommended, and to whom."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest

from pebble.check_result import State
from pebble.config import parse
from pebble.extensions.checks.devices import camera, cameras, device, loudspeaker, microphone, serial_port

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
    link(tmp_path, links)
    result = device(tmp_path / name, "it", KEY, tmp_path / "serial")
    assert result.state is (State.WARN if better else State.OK)
    assert result.fix == (f"set {KEY} to {tmp_path / 'serial' / better}" if better else "")


def link(tmp_path: Path, links: dict[str, str]) -> None:
    for name, target in links.items():
        path = tmp_path / "serial" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.symlink_to(tmp_path / target)


@pytest.mark.parametrize(
    ("place", "usable", "state", "text", "fix"),
    [
        ("gone", True, State.FAILED, "is the MCU plugged in?", "ls -l "),
        ("file", True, State.FAILED, "is not a device", f"correct {KEY}"),
        ("tty", True, State.OK, "readable and writable", ""),
        ("tty", False, State.FAILED, "only be used by its owner", "sudo usermod -aG $(stat -c %G /"),
    ],
)
def test_serial_port(
    place: str, usable: bool, state: State, text: str, fix: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").touch()
    (tmp_path / "tty").symlink_to(os.ttyname(os.openpty()[1]))
    monkeypatch.setattr(os, "access", lambda *_: usable)
    result = serial_port(tmp_path / place, KEY)
    assert (result.state, text in result.text, result.fix.startswith(fix)) == (state, True, True)


CAMERA = {"enabled": True, "video": {"device": "0"}}
NO_CAMERA = (State.FAILED, "video0 does not exist", "ls -l ")
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
