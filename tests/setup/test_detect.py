"""Boards are recognised by what they send, and never written to; a machine that lacks something is described."""

from __future__ import annotations

import os
import pty
import select
import subprocess
import sys
import threading
import tty
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from pebble.services.serial_mcu_bridge.pebble_serial_v1 import frame
from pebble.setup import detect
from pebble.setup.detect import Machine
from pebble.setup.places import Places
from pebble.setup.steps import State
from tests.setup.rig import machine_root, set_up
from tests.support import needs_root

_LISTENS = "mosquitto listens with logins, and beyond this machine encrypted"
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

    thread = threading.Thread(target=send)
    thread.start()
    try:
        yield ours
    finally:
        ending.set()
        thread.join()
        os.close(theirs)
        os.close(ours)


@pytest.mark.parametrize(
    ("sends", "text", "protocol"),
    [
        (b"T t0=1 t1=2 t2=3 chg=1\nC v=7.4\n", "460800 baud, answers, `C`, `T` lines", "goob_base_v1"),
        (b"I n=1 ms=2 ax=0\n", "460800 baud, answers, `I` lines", "imu_mpu6050_v1"),
        (_HELLO, "460800 baud, answers, frames", "pebble_serial_v1"),
        (b"", "silent", None),
        (b"\xff\xfe\x80\n\xc3\x28\n", "silent", None),
    ],
    ids=("motor board", "inertial sensor", "describes itself", "silent", "wrong speed"),
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


def test_a_file_that_is_no_camera_is_none(tmp_path: Path) -> None:
    cameras = tmp_path / "v4l/by-id"
    cameras.mkdir(parents=True)
    (cameras / "usb-1").symlink_to("/dev/null")
    assert not any("usb-1" in camera for camera in detect.cameras(tmp_path))


@pytest.mark.parametrize(
    ("machine", "step", "text"),
    [
        (Machine(mosquitto=detect.NO_MOSQUITTO), _LISTENS, "sudo apt install mosquitto"),
        (Machine(polkit=detect.NO_POLKIT), "the page may restart and reboot the robot", "polkit is not installed"),
        (Machine(writable="/etc is read-only: …"), "config", "/etc is read-only"),
    ],
)
def test_a_step_that_the_machine_does_not_allow_gives_the_reason(
    machine: Machine, step: str, text: str, root: Path
) -> None:
    found = {result.step.what: result for result in set_up(root, machine)}
    assert found[step].state is State.CANNOT
    assert text in found[step].why
    done = {result.step.what: result.state for result in set_up(root)}
    assert done[step] is State.NEW, "the next run does what was left"


@pytest.mark.parametrize(
    ("lacking", "text"),
    [
        (detect.bits(2**31), "32 bits, for which the versions of packages are not locked"),
        (detect.unset_clock(0.0, None), "the clock is set to 1970, so certificates would be refused: sudo timedatectl"),
        (Machine(network=detect.OFFLINE).lacks()[0], "no network, so no phone reaches it"),
    ],
)
def test_what_no_step_depends_on_is_described(lacking: str, text: str) -> None:
    assert text in lacking


def test_a_machine_that_lacks_nothing(root: Path) -> None:
    assert detect.bits(2**63) == ""
    assert detect.unset_clock(1.8e9, True) == ""
    found = detect.machine(Places(root))
    assert (found.mosquitto, found.polkit, found.writable) == ("", "", "")
    assert "pebble.service is not installed" in found.unit


@pytest.mark.parametrize("name", ["mosquitto.conf", "conf.d/own.conf"])
def test_a_broker_with_listeners_of_its_own_is_left_alone(name: str, root: Path) -> None:
    file = root / "etc/mosquitto" / name
    file.parent.mkdir(exist_ok=True)
    file.write_text("# mine\nlistener 1883\n")
    assert f"/etc/mosquitto/{name} has its own `listener`" in detect.machine(Places(root)).mosquitto


@needs_root
def test_a_read_only_root_is_recognised(tmp_path: Path) -> None:
    root = machine_root(tmp_path)
    command = f'mount --bind -o ro {root} {root} && mount -o remount,bind,ro {root} && exec "$@"'
    script = (
        "from pathlib import Path; from pebble.setup.detect import unwritable; from pebble.setup.places import Places;"
        f"print(unwritable(Places(Path({str(root)!r}))))"
    )
    done = subprocess.run(
        ["unshare", "-m", "sh", "-c", command, "sh", sys.executable, "-c", script],
        capture_output=True,
        text=True,
        check=True,
        timeout=60,
    )
    assert done.stdout.strip() == f"{root}/etc is read-only: sudo mount -o remount,rw {root}/etc"
