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
from pebble.setup.manifest import Manifest
from pebble.setup.places import Places
from pebble.setup.plan import Plan, steps
from pebble.setup.questions import Secrets, combined
from pebble.setup.steps import Engine, State
from tests.setup.rig import ANSWERS, machine_root, set_up
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
        (Machine(mosquitto=detect.NO_MOSQUITTO), _LISTENS, detect.NO_MOSQUITTO),
        (Machine(polkit=detect.NO_POLKIT), "the page may restart and reboot the robot", detect.NO_POLKIT),
        (Machine(writable="/etc is read-only: …"), "config", "/etc is read-only: …"),
    ],
)
def test_a_step_that_the_machine_does_not_allow_gives_the_reason(
    machine: Machine, step: str, text: str, root: Path
) -> None:
    found = {result.step.what: result for result in set_up(root, machine)}
    assert found[step].state is State.CANNOT
    assert found[step].why == text
    done = {result.step.what: result.state for result in set_up(root)}
    assert done[step] is State.NEW, "the next run does what was left"


SERVICE = "the robot starts with the machine"
#: What a machine lacks, as a person reads it: the step that is not done, or none, and the whole text.
LACKING = {
    "no systemd": (
        {"systemd": detect.NO_SYSTEMD},
        SERVICE,
        "systemd does not run here, so nothing starts the robot with the machine: pebble up /etc/pebble/robot.json",
    ),
    "no unit": (
        {"unit": detect.NO_UNIT},
        SERVICE,
        "pebble.service is not installed, so nothing starts the robot with the machine:"
        " sudo apt install ./pebble-robot_….deb, then sudo pebble setup",
    ),
    "no mosquitto": (
        {"mosquitto": detect.NO_MOSQUITTO},
        _LISTENS,
        "mosquitto is not installed, so there is no broker on this robot:"
        " sudo apt install mosquitto, then sudo pebble setup",
    ),
    "no polkit": (
        {"polkit": detect.NO_POLKIT},
        "the page may restart and reboot the robot",
        "polkit is not installed, so the page cannot restart or reboot the robot:"
        " sudo apt install polkitd, then sudo pebble setup",
    ),
    "32 bits": (
        {"bits": detect.bits(2**31)},
        None,
        "this system has 32 bits, for which the versions of packages are not locked: install one of 64 bits",
    ),
    "offline": (
        {"network": detect.OFFLINE},
        None,
        "this machine has no network, so no phone reaches it: join one, such as by sudo nmtui,"
        " then sudo pebble cert renew --folder /etc/pebble/tls NAME.local ADDRESS",
    ),
    "unset clock": (
        {"clock": detect.unset_clock(0.0, None)},
        None,
        "the clock is set to 1970, so certificates would be refused: sudo timedatectl set-ntp true,"
        " then sudo pebble cert renew --folder /etc/pebble/tls",
    ),
}


@pytest.mark.parametrize(("machine", "what", "text"), LACKING.values(), ids=LACKING)
def test_what_a_machine_does_not_allow_is_named_with_what_to_type(
    machine: dict[str, str], what: str | None, text: str, root: Path
) -> None:
    wanted = Plan(Places(root), combined(ANSWERS), Machine(**machine), Manifest(), Secrets())
    found = Engine(wanted.places, wanted.manifest, is_live=True).states(steps(wanted))
    cannot = [(result.step.what, result.why) for result in found if result.state is State.CANNOT]
    assert (what, text) in [*cannot, *((None, why) for why in wanted.machine.lacks())]


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
    assert done.stdout.strip() == f"{root}/etc is read-only: sudo mount -o remount,rw {root}, then sudo pebble setup"
