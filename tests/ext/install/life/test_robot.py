"""A whole robot of the package under a real systemd: it drives, stops, shows and sounds within its unit's limits."""

from __future__ import annotations

import pytest

from tests.ext.install.life.robots import Robot
from tests.kit.machine import Machine
from tests.support import until

ATTEMPTS = """
import ctypes, mmap, os, pathlib, socket
libc = ctypes.CDLL(None, use_errno=True)
attempts = {
    "write the system": lambda: open("/etc/pebble-was-here", "w"),
    "write its software": lambda: open("/opt/pebble/a/pebble-was-here", "w"),
    "tune the kernel": lambda: open("/proc/sys/kernel/hostname", "w"),
    "see another's files": lambda: list(pathlib.Path("/tmp").glob("of-another*"))[0],
    "sniff": lambda: socket.socket(17, socket.SOCK_RAW),
    "make a namespace": lambda: 1 / (libc.unshare(0x20000) == 0),
    "run in real time": lambda: os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1)),
    "execute what it wrote": lambda: mmap.mmap(-1, 4096, prot=mmap.PROT_READ | mmap.PROT_WRITE | mmap.PROT_EXEC),
    "give a file away": lambda: os.chown(os.environ["STATE_DIRECTORY"], 1, 1),
    "use shared memory": lambda: os.close(os.memfd_create("frame")),
    "write its own folder": lambda: pathlib.Path(os.environ["STATE_DIRECTORY"], "a").write_text("b"),
    "be nice": lambda: os.nice(1),
    "open a socket": lambda: socket.socket().close(),
}
for name, attempt in attempts.items():
    try:
        attempt()
        print(name)
    except (OSError, IndexError, ZeroDivisionError):
        pass
"""
#: The robot's unit, which tries them once in place of the robot.
ATTEMPT = """[Service]
Type=oneshot
Restart=no
WatchdogSec=0
ExecStart=
ExecStart=/opt/pebble/a/bin/python3 /usr/share/attempts.py
"""


def test_a_process_in_the_robots_unit_can_do_what_a_robot_does_and_no_more(machine: Machine) -> None:
    machine.write("/usr/share/attempts.py", ATTEMPTS)
    machine.write("/etc/systemd/system/attempts.service.d/attempt.conf", ATTEMPT)
    machine.sh(
        "chmod 644 /usr/share/attempts.py; touch /tmp/of-another;"
        "cp /usr/lib/systemd/system/pebble.service /etc/systemd/system/attempts.service;"
        "systemctl daemon-reload; systemctl start attempts.service"
    )
    possible = ["use shared memory", "write its own folder", "be nice", "open a socket"]
    printed = machine.journal("attempts.service").splitlines()
    assert [line for line in printed if f'"{line}":' in ATTEMPTS] == possible


def test_a_robot_with_media_drives_stops_shows_and_sounds(machine: Machine) -> None:
    robot = Robot(machine)
    robot.configure()
    robot.plug_in()
    robot.start()
    for flag, ask in (("mqtt-video", "front-camera"), ("mqtt-audio", "audio")):
        robot.send(f"incoming/flags/{flag}", True, "-r")
        robot.send(f"incoming/{ask}", {"enabled": True})
    assert robot.receives("outgoing/front-camera")
    assert robot.receives("outgoing/audio")
    assert not robot.board.turning()
    robot.send("incoming/drive-values", {"x": 0, "z": 0.5})
    assert until(robot.board.motors, 10, step=0.1), "it drives"
    assert until(lambda: not robot.board.turning(), 10, step=0.1), "it stops without further commands"
    status = machine.sh("cat /proc/$(systemctl show --value --property=MainPID pebble.service)/status")
    assert "Seccomp:\t2" in status
    assert "CapBnd:\t0000000000000000" in status
    assert "not permitted" not in machine.journal("pebble.service")


@pytest.mark.parametrize("signal", ["KILL", "ABRT"])
def test_a_robot_that_ends_comes_back_from_its_slot(machine: Machine, signal: str) -> None:
    robot = Robot(machine)
    robot.configure()
    robot.plug_in()
    robot.start()
    machine.run("systemctl", "kill", "--kill-whom=main", f"--signal={signal}", "pebble.service")
    assert robot.receives("outgoing/online")
    assert robot.runs_from() == "a"
