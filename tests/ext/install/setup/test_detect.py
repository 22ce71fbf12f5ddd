"""Boards are recognised by what they send, and never written to; a machine that lacks something is described."""

from __future__ import annotations

import os
import pty
import select
import threading
import tty
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from pebble.extensions.install.setup import detect, system
from pebble.extensions.install.setup.system import SetupError
from pebble.extensions.operator.places import Places
from pebble.services.serial_mcu_bridge.pebble_serial_v1 import frame
from tests.support import beside

_HELLO = frame.encode(frame.Frame(frame.Type.HELLO, b"x"))


@contextmanager
def board(folder: Path, sends: bytes) -> Iterator[int]:
    """A serial port, as a link in a folder, that sends this again and again."""
    ours, theirs = pty.openpty()
    tty.setraw(theirs)
    (folder / "usb-board").symlink_to(os.ttyname(theirs))
    ending = threading.Event()

    def send() -> None:
        while not ending.wait(0.01):
            if sends and select.select([], [ours], [], 0)[1]:
                os.write(ours, sends)

    with beside(send, ending):
        yield ours
    os.close(theirs)
    os.close(ours)


@pytest.mark.parametrize(
    ("sends", "text", "protocol"),
    [
        (b"T t0=1 t1=2 t2=3 chg=1\nC v=7.4\n", "460800 baud, answers, `C`, `T` lines", "goob_base_v1"),
        (b"I n=1 ms=2 ax=0\n", "460800 baud, answers, `I` lines", "imu_mpu6050_v1"),
        (_HELLO, "460800 baud, answers, frames", "pebble_serial_v1"),
        (b"\xff\xfe\x80\n\xc3\x28\n", "silent", None),
    ],
    ids=("motor board", "inertial sensor", "describes itself", "wrong speed"),
)
def test_a_board_is_listened_to(sends: bytes, text: str, protocol: str | None, tmp_path: Path) -> None:
    with board(tmp_path, sends) as ours:
        (found,) = detect.boards(tmp_path, seconds=0.2)
        written = select.select([ours], [], [], 0)[0]
    assert (found.text.rpartition(" at ")[2], found.protocol) == (text, protocol)
    assert written == [], "nothing was written to it"


def test_a_port_that_cannot_be_opened_is_described(tmp_path: Path) -> None:
    (tmp_path / "usb-gone").symlink_to("/dev/no-such-port")
    (found,) = detect.boards(tmp_path)
    assert found.text.startswith("cannot be opened")


def test_a_camera_is_known_by_the_name_that_stays(tmp_path: Path) -> None:
    cameras = tmp_path / "v4l/by-id"
    cameras.mkdir(parents=True)
    for index in (0, 1):
        (cameras / f"usb-cam-video-index{index}").symlink_to("/dev/null")
    assert [camera for camera in detect.cameras(tmp_path) if "usb" in camera] == [f"{cameras}/usb-cam-video-index0"]


@pytest.mark.parametrize("name", ["mosquitto.conf", "conf.d/own.conf"])
def test_a_broker_with_listeners_of_its_own_is_left_alone(name: str, root: Path) -> None:
    assert detect.no_broker(Places(root)) == ""
    (root / "etc/mosquitto" / name).write_text("# mine\nlistener 1883\n")
    assert detect.no_broker(Places(root)).startswith(f"/etc/mosquitto/{name} has its own `listener`")


def test_what_a_machine_lacks_is_named_with_what_to_type(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (root / "usr/lib/polkit-1/polkitd").unlink()
    monkeypatch.setattr("time.time", lambda: 0.0)
    monkeypatch.setattr(detect, "_has_network", lambda: False)
    first, clock, last = detect.lacks(Places(root))
    assert (first, last) == (detect.NO_POLKIT, detect.OFFLINE)
    assert clock.startswith("The clock is set to 1970")


def test_a_machine_without_the_package_is_told_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(system, "is_root", lambda: False)
    with pytest.raises(SetupError, match=r"^only root can do this: sudo pebble setup$"):
        system.owner_of("root:pebble")
    monkeypatch.setattr(system, "is_root", lambda: True)
    with pytest.raises(SetupError, match=r"^there is no user no-such: sudo apt install no-such, then sudo"):
        system.owner_of("root:no-such")
