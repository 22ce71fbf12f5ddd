"""Devices by a name that stays: what is recommended, and to whom."""

from __future__ import annotations

from pathlib import Path

import pytest

from pebble.checks.check import State
from pebble.checks.devices import missing, serial_port, usable
from pebble.checks.media import camera

KEY = "a.b"


@pytest.mark.parametrize(
    ("device", "links", "named"),
    [
        ("ttyACM0", {"by-id/usb-board-if00": "ttyACM0"}, "by-id/usb-board-if00"),
        ("ttyUSB12", {"by-id/usb-1a86_USB_Serial-if00-port0": "ttyUSB12"}, "by-id/usb-1a86_USB_Serial-if00-port0"),
        ("video0", {"by-id/usb-cam-video-index0": "video0"}, "by-id/usb-cam-video-index0"),
        ("ttyACM1", {"by-id/usb-a": "ttyACM0", "by-id/usb-b": "ttyACM1"}, "by-id/usb-b"),
        # Two adapters without a serial number have one id: the other one is found by where it is plugged in.
        ("ttyUSB0", {"by-id/usb-same": "ttyUSB1", "by-path/usb-0:1.2": "ttyUSB0"}, "by-path/usb-0:1.2"),
        ("ttyACM0", {"by-id/usb-gone": "ttyACM7"}, ""),
        ("ttyACM0", {}, ""),
        ("ttyAMA0", {"by-id/usb-board": "ttyAMA0"}, ""),  # a port of the computer itself: its number stays
        ("goob", {"by-id/usb-board": "goob"}, ""),  # a name that its owner gave it
    ],
)
def test_a_number_that_may_change(tmp_path: Path, device: str, links: dict[str, str], named: str) -> None:
    for place in range(13):
        for kind in ("ttyACM", "ttyUSB", "video"):
            (tmp_path / f"{kind}{place}").touch()
    (tmp_path / device).touch()
    (tmp_path / "ttyACM7").unlink()
    link(tmp_path, links)
    found = usable(tmp_path / device, "readable", KEY, tmp_path / "serial")
    assert found.state is (State.WARN if named else State.OK)
    assert found.fix == (f"set {KEY} to {tmp_path / 'serial' / named}" if named else "")


@pytest.mark.parametrize(
    ("links", "only"),
    [
        ([], ""),
        (["usb-board"], "usb-board"),
        (["usb-board", "usb-imu"], ""),
        (["usb-cam-video-index0", "usb-cam-video-index1"], "usb-cam-video-index0"),
    ],
)
def test_what_is_missing_may_be_there_by_another_name(tmp_path: Path, links: list[str], only: str) -> None:
    link(tmp_path, {f"by-id/{name}": "x" for name in links})
    found = missing("does not exist", KEY, tmp_path / "serial")
    folder = tmp_path / "serial" / "by-id"
    assert found.fix == (f"set {KEY} to {folder / only}" if only else f"ls -l {folder}/")


def test_ports_and_cameras_are_asked_for_it(tmp_path: Path) -> None:
    link(tmp_path, {"by-id/usb-board": "ttyACM3"})
    assert serial_port(tmp_path / "ttyACM0", KEY, tmp_path / "serial").fix.startswith(f"set {KEY} to ")
    (tmp_path / "serial").rename(tmp_path / "v4l")
    found = camera("v4l2", "0", tmp_path)
    assert found.fix == f"set services.av_daemon.video.device to {tmp_path}/v4l/by-id/usb-board"


def link(tmp_path: Path, links: dict[str, str]) -> None:
    for name, device in links.items():
        path = tmp_path / "serial" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.symlink_to(tmp_path / device)
