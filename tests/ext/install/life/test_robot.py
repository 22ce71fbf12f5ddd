"""Whole robots under a real systemd: within the unit's limits, and from a file of answers or a backup."""

from __future__ import annotations

import json
from typing import Any

from pebble.extensions.checks.report.secrets_here import secrets_of
from pebble.extensions.operator.places import Places
from tests.ext.install.life.robots import BASE, PORT, ROBOT, Robot
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
    assert until(robot.board.motors, step=0.1), "it drives"
    assert until(lambda: not robot.board.turning(), step=0.1), "it stops without further commands"
    status = machine.sh("cat /proc/$(systemctl show --value --property=MainPID pebble.service)/status")
    assert "Seccomp:\t2" in status
    assert "CapBnd:\t0000000000000000" in status
    assert "not permitted" not in machine.journal("pebble.service")


def test_a_robot_that_is_killed_comes_back_from_its_slot(machine: Machine) -> None:
    robot = Robot(machine)
    robot.configure()
    robot.plug_in()
    robot.start()
    machine.run("systemctl", "kill", "--kill-whom=main", "--signal=KILL", "pebble.service")
    assert robot.receives("outgoing/online")
    assert robot.runs_from() == "a"


PASSWORD = "correct horse battery"
ANSWERS: dict[str, Any] = {
    "id": ROBOT,
    "port": PORT,
    "protocol": "goob_base_v1",
    "camera": "none",
    "broker": "here",
    "page": True,
    "user": "ann",
    "password_file": "/srv/password",
}
#: As a browser does, except that it takes the robot's own certificate as it comes.
LOG_IN = f"""
import json, ssl, urllib.request
context = ssl._create_unverified_context()
def ask(path, body=None):
    data = None if body is None else json.dumps(body).encode()
    headers = {{"Content-Type": "application/json", "Origin": "https://127.0.0.1:8080"}}
    request = urllib.request.Request("https://127.0.0.1:8080" + path, data, headers)
    return urllib.request.urlopen(request, context=context).status
print(ask("/"), ask("/api/login", {{"user": "ann", "password": "{PASSWORD}"}}))
"""


SETUP = ("pebble", "setup", "--answers", "/srv/answers.json")
#: What a person types on a robot, with which outputs go to others.
COMMANDS = (
    ("pebble", "doctor", "/etc/pebble/robot.json", "--running"),
    ("pebble", "doctor", "/etc/pebble/robot.json"),
    ("pebble", "doctor", "--report", "/srv/goob.zip"),
    ("pebble", "setup", "--backup", "/srv/goob.tar"),
    ("pebble", "web", "user", "list"),
    ("systemctl", "restart", "pebble.service"),
)
#: Everything but what the robot writes while it runs.
OWNERS = "find /etc/pebble /etc/mosquitto /var/lib/pebble/people.sqlite -not -type l -printf '%u:%g %m %p\n' | sort"
BLANK = (
    "systemctl disable --now pebble; systemctl stop mosquitto;"
    "rm -r /etc/pebble /var/lib/pebble /etc/mosquitto/pebble /etc/mosquitto/conf.d/pebble.conf;"
    "systemd-tmpfiles --create pebble.conf"
)


def test_package_and_setup_make_a_robot_with_heartbeats_and_let_its_user_in(machine: Machine) -> None:
    robot = Robot(machine)
    robot.plug_in()
    machine.write("/srv/password", PASSWORD)
    machine.write("/srv/answers.json", json.dumps(ANSWERS))
    machine.run("chmod", "600", "/srv/password")
    with machine.processes_watched() as seen:
        done = machine.run(*SETUP, timeout=300)
        remote = json.loads(machine.run("cat", "/etc/pebble/robot.json"))["services"]["mqtt_bridge"]["remote_mqtt"]
        login = ("-h", remote["host"], "-p", str(remote.get("port", 1883)), "-u", remote["username"])
        # mosquitto_sub takes passwords from this file, or else only on its command line
        options = f"-P $(cat /etc/pebble/{remote['password_file']})"
        machine.sh(f'mkdir -p /root/.config && echo "{options}" >/root/.config/mosquitto_sub')
        receives = ("mosquitto_sub", *login, "-R", "-C", "5", "-W", "60", "-t", f"{BASE}/outgoing/online")
        assert machine.succeeds(*receives)
        log_in = ("python3", "-")
        assert until(lambda: machine.run(*log_in, check=False, given=LOG_IN) == "200 200\n", 60, step=1), done
        shown = [done, *(machine.run(*command, check=False, timeout=300) for command in COMMANDS)]
        assert machine.succeeds(*receives)
        again = machine.run(*SETUP, timeout=300)
        assert "All is so already." in again
        before = machine.sh(OWNERS)
        machine.sh(BLANK)
        restored = ("pebble", "setup", "--from", "/srv/goob.tar")
        shown.append(machine.run(*restored, timeout=300, given="y\n"))  # its board is in /run, which is asked for
        assert machine.succeeds(*receives), "the backup is the same robot"
        assert machine.sh(OWNERS) == before
        machine.run("env", "PLANTED=in-an-environment", "sleep", "1.5")
    texts = [*(text.decode(errors="replace") for text in seen), *shown, machine.run("journalctl", "--output=export")]
    secrets = secrets_of(Places(machine.root), None, [machine.root / "srv/password"])
    assert len(secrets.known) > 5, "passwords, and keys of the page and of the broker"
    assert [text for text in texts if secrets.hidden(text) != text] == []
    planted = (b"in-an-environment", b"sleep\x001.5", b"mosquitto_sub\0", b"--running\0", b"--report\0", b"--backup\0")
    assert [text for text in planted if not any(text in one for one in seen)] == [], "that is found where it is"
