"""The units confine a robot, and a confined robot drives, shows, sounds and runs its actions."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NoReturn

import pytest

from tests.robot.rig import DEVICES, Rig
from tests.robot.test_media import ASK_AUDIO, AUDIO, AUDIO_FLAG, pictures_come, want_video
from tests.support import ROOT, until

sys.path.insert(0, str(ROOT / "tools"))
import emulate_unit  # type: ignore[import-not-found]

UNITS = ROOT / "configs" / "systemd"
NAMES = ("pebble", "pebble-update", "pebble-web", "pebble-record", "pebble-hub", "pebble-gateway")
ROBOT, UPDATE, PAGE, RECORDER, HUB, GATEWAY = (UNITS / f"{name}.service" for name in NAMES)
MOST_EXPOSED = 20  # tenths, of systemd-analyze
#: What every unit says, whatever systemd-analyze makes of the rest.
CONFINED = {
    "NoNewPrivileges": ["yes"],
    "CapabilityBoundingSet": [],
    "AmbientCapabilities": [],
    "ProtectSystem": ["strict"],
    "ProtectHome": ["yes"],
    "ProtectProc": ["invisible"],
    "PrivateTmp": ["yes"],
    "ProtectControlGroups": ["yes"],
    "ProtectKernelTunables": ["yes"],
    "ProtectKernelModules": ["yes"],
    "ProtectKernelLogs": ["yes"],
    "ProtectClock": ["yes"],
    "ProtectHostname": ["yes"],
    "RestrictNamespaces": ["yes"],
    "RestrictRealtime": ["yes"],
    "RestrictSUIDSGID": ["yes"],
    "LockPersonality": ["yes"],
    "RemoveIPC": ["yes"],
    "SystemCallArchitectures": ["native"],
    "SystemCallErrorNumber": ["EPERM"],
    "UMask": ["0077"],
}
#: And what the robot's says besides.
ROBOTS_OWN = {
    "User": ["pebble"],
    "StateDirectoryMode": ["0700"],
    "RuntimeDirectoryMode": ["0700"],
    "DevicePolicy": ["closed"],
    "RestrictAddressFamilies": ["AF_UNIX AF_INET AF_INET6 AF_NETLINK"],
    "MemoryDenyWriteExecute": ["yes"],
    "LimitCORE": ["0"],
    "LimitMEMLOCK": ["infinity"],
    "MemoryMax": ["85%"],
    "OOMPolicy": ["continue"],
}
#: Devices that a robot uses, and the modules that make their kinds known; None: the kernel has them built in.
MODULES = {
    "char-ttyACM": "cdc_acm",
    "char-ttyUSB": "usbserial",
    "char-ttyS": None,
    "char-ttyAMA": None,
    "char-video4linux": "videodev",
    "char-media": "mc",
    "char-dma_heap": None,
    "char-alsa": "snd",
}
RESTART, REBOOT = "org.freedesktop.systemd1.manage-units", "org.freedesktop.login1.reboot"

units = pytest.mark.parametrize("unit", [ROBOT, UPDATE, PAGE, RECORDER, HUB, GATEWAY], ids=lambda path: path.stem)


def unavailable(reason: str) -> NoReturn:
    pytest.skip(reason)


@pytest.fixture
def analyze() -> Callable[..., subprocess.CompletedProcess[str]]:
    if shutil.which("systemd-analyze") is None:
        unavailable("needs systemd-analyze (apt install systemd)")

    def run(*arguments: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(["systemd-analyze", *arguments], capture_output=True, text=True, check=False, timeout=60)

    return run


# -- what the units say


@units
def test_every_unit_confines(unit: Path) -> None:
    keys = emulate_unit.service(unit.read_text())
    expected = {**CONFINED, "UMask": ["0022"]} if unit == UPDATE else CONFINED  # others run what it installs
    assert {key: keys.get(key) for key in expected} == expected
    assert keys["SystemCallFilter"][0] == "@system-service"
    assert keys["SystemCallFilter"][1].startswith("~@privileged @resources")


def test_the_robots_unit_leaves_what_a_robot_needs() -> None:
    keys = emulate_unit.service(ROBOT.read_text())
    assert {key: keys.get(key) for key in ROBOTS_OWN} == ROBOTS_OWN
    assert keys["SystemCallFilter"][2:] == ["@memlock sched_setaffinity sched_setscheduler setpriority"]
    assert not {"ProcSubset", "PrivateIPC", "PrivateDevices", "PrivateNetwork"} & keys.keys()


def test_every_device_that_may_be_plugged_in_later_has_its_driver_loaded_before() -> None:
    text = ROBOT.read_text()
    devices = [value.removesuffix(" rw") for value in emulate_unit.service(text)["DeviceAllow"]]
    assert devices == list(MODULES)
    wanted, after = (re.search(rf"^{key}=modprobe@(.*)$", text, re.MULTILINE) for key in ("Wants", "After"))
    assert wanted is not None
    assert after is not None
    assert wanted[1] == after[1]
    loaded = [word.removeprefix("modprobe@").removesuffix(".service") for word in wanted[1].split()]
    assert loaded == [module for module in MODULES.values() if module]


@units
def test_systemd_knows_every_key(unit: Path, tmp_path: Path, analyze: Callable[..., subprocess.CompletedProcess[str]]):
    copy = tmp_path / unit.name
    copy.write_text(re.sub(r"^ExecStart=\S+", "ExecStart=/bin/true", unit.read_text(), flags=re.MULTILINE))
    done = analyze("verify", "--man=no", str(copy))
    assert [line for line in done.stderr.splitlines() if unit.name in line] == []


@units
def test_systemd_rates_the_exposure_as_ok(unit: Path, analyze: Callable[..., subprocess.CompletedProcess[str]]) -> None:
    done = analyze("security", "--offline=true", "--no-pager", f"--threshold={MOST_EXPOSED}", str(unit))
    assert done.returncode == 0, done.stdout.splitlines()[-1:] + done.stderr.splitlines()


# -- actions


def granted(tmp_path: Path, *cases: tuple[str, str, dict[str, str]]) -> list[bool]:
    """What the shipped rule answers to each (user, action, details)."""
    if shutil.which("node") is None:
        unavailable("needs Node.js (apt install nodejs)")
    script = tmp_path / "rules.js"
    script.write_text(
        'let rule; const polkit = {Result: {YES: "yes", NOT_HANDLED: null}, addRule: (added) => { rule = added; }};\n'
        f"{(UNITS / '50-pebble.rules').read_text()}\n"
        "const asked = ([user, id, details]) => rule({id, lookup: (key) => details[key]}, {user});\n"
        'console.log(JSON.stringify(JSON.parse(process.argv[2]).map((one) => asked(one) === "yes")));\n'
    )
    done = subprocess.run(
        ["node", str(script), json.dumps(cases)], capture_output=True, text=True, check=False, timeout=60
    )
    assert done.returncode == 0, done.stderr
    return list(json.loads(done.stdout))


def action_commands() -> list[list[str]]:
    """The commands of the three actions, as the unit's comment gives them."""
    return [json.loads(line) for line in re.findall(r'^# +(\["systemctl".*\])$', ROBOT.read_text(), re.MULTILINE)]


def test_polkit_allows_the_commands_that_the_unit_recommends_and_only_the_robot(tmp_path: Path) -> None:
    reboot, restart, update = action_commands()
    assert reboot == ["systemctl", "--no-ask-password", "reboot"]
    jobs = [{"verb": command[-2], "unit": command[-1]} for command in (restart, update)]
    asked = [(REBOOT, {}), (f"{REBOOT}-multiple-sessions", {}), *((RESTART, job) for job in jobs)]
    users = ("pebble", "pebble-web", "pebble-update", "")
    answers = granted(tmp_path, *((user, *one) for user in users for one in asked))
    assert answers == [True] * 4 + [False] * 12
    assert jobs[1]["unit"] == UPDATE.name


def test_polkit_allows_the_robot_nothing_else(tmp_path: Path) -> None:
    others = [
        *({"verb": verb, "unit": "pebble.service"} for verb in ("start", "stop", "kill", "set-property", "reload", "")),
        *({"verb": "restart", "unit": unit} for unit in ("ssh.service", "pebble-web.service", "pebble-update.service")),
        {"verb": "start", "unit": "pebble.service.d"},
        {"verb": "stop", "unit": "pebble-update.service"},
        {},
    ]
    cases = [("pebble", RESTART, details) for details in others]
    cases += [
        ("pebble", action, {})
        for action in (
            *(f"{REBOOT}-ignore-inhibit", "org.freedesktop.login1.power-off"),
            *("org.freedesktop.systemd1.manage-unit-files", "org.freedesktop.systemd1.reload-daemon"),
            "org.freedesktop.policykit.exec",
        )
    ]
    assert granted(tmp_path, *cases) == [False] * len(cases)


def test_the_update_writes_the_checkout_only_and_installs_what_the_lock_names() -> None:
    keys = emulate_unit.service(UPDATE.read_text())
    assert keys["User"] == ["pebble-update"]
    assert keys["ReadWritePaths"] == ["/opt/pebble"]
    locked = re.compile(r"install --require-hashes -r /opt/pebble/(\S+)$")
    (lock,) = (found[1] for line in keys["ExecStart"] if (found := locked.search(line)))
    assert (ROOT / lock).is_file()
    assert [line for line in keys["ExecStart"] if "pip install" in line and "--require-hashes" not in line] == [
        "/opt/pebble/venv/bin/pip install --no-deps --no-build-isolation /opt/pebble"
    ]


# -- within the limits

ATTEMPTS = """
import ctypes, mmap, os, pathlib, socket
libc = ctypes.CDLL(None, use_errno=True)
attempts = {
    "write the system": lambda: open("/etc/pebble-was-here", "w"),
    "write its software": lambda: open(os.environ["OWN"] + "/pebble-was-here", "w"),
    "tune the kernel": lambda: open("/proc/sys/kernel/hostname", "w"),
    "see another's files": lambda: list(pathlib.Path("/tmp").glob("of-another*"))[0],
    "sniff": lambda: socket.socket(17, socket.SOCK_RAW),
    "make a namespace": lambda: 1 / (libc.unshare(0x20000) == 0),
    "run in real time": lambda: os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1)),
    "execute what it wrote": lambda: mmap.mmap(-1, 4096, prot=mmap.PROT_READ | mmap.PROT_WRITE | mmap.PROT_EXEC),
    "give a file away": lambda: os.chown(os.environ["FOLDER"], 1, 1),
    "use shared memory": lambda: os.close(os.memfd_create("frame")),
    "write its own folder": lambda: pathlib.Path(os.environ["FOLDER"], "a").write_text("b"),
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


def confined(folder: Path, *command: str) -> list[str]:
    """The command within the robot's unit, where only ``folder`` is writable."""
    reads = {str(Path(path).resolve()) for path in (ROOT, sys.prefix, sys.base_prefix)}
    shown = [word for path in sorted(reads) for word in ("--read", path)]
    tool = str(ROOT / "tools" / "emulate_unit.py")
    return [sys.executable, tool, *shown, "--write", str(folder), str(ROBOT), "--", *command]


@pytest.fixture(scope="module")
def emulation(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Skips where the machine lacks something for it."""
    command = confined(tmp_path_factory.mktemp("probe"), "true")
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
    if done.returncode != 0:
        unavailable(done.stderr.strip() or done.stdout)


def test_a_process_in_the_robots_unit_can_do_what_a_robot_does_and_no_more(tmp_path: Path, emulation: None) -> None:
    own = tmp_path / "own"
    own.mkdir()
    command = confined(own, sys.executable, "-c", ATTEMPTS)
    environment = {**os.environ, "FOLDER": str(own), "OWN": str(ROOT)}
    with tempfile.NamedTemporaryFile(prefix="of-another", dir="/tmp"):
        done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60, env=environment)
    first, *possible = done.stdout.splitlines()
    assert first.startswith("pebble.service: not emulated: DeviceAllow, DevicePolicy, ")
    assert possible == ["use shared memory", "write its own folder", "be nice", "open a socket"], done.stderr


class ConfinedRig(Rig):
    """A rig whose robot runs within the limits of its unit; brokers, operator and MCU do not."""

    def start(self, ready: bool = True) -> float:
        began = time.monotonic()
        command = confined(self.folder, sys.executable, "-m", "pebble.cli", "up", str(self.config))
        with self.log.open("ab") as log:
            self._robot = subprocess.Popen(command, cwd=ROOT, stderr=log, stdout=log)
        self.wait_until_up(began, 30)
        return began


@pytest.fixture(scope="module")
def rig(emulation: None) -> Iterator[Rig]:
    with ConfinedRig("zenoh", av_daemon=DEVICES) as rig:
        yield rig


@pytest.mark.alone
def test_a_confined_robot_drives_shows_sounds_and_acts(rig: Rig) -> None:
    began = want_video(rig, encoding="h264")
    rig.operator.send(AUDIO_FLAG, True, retain=True)
    rig.operator.send(ASK_AUDIO, {"enabled": True, "encoding": "opus"})
    rig.operator.send("incoming/flags/git-pull", True)
    assert pictures_come(rig, began)
    assert until(lambda: len(rig.operator.on(AUDIO, began)) > 3, 15)
    assert until(lambda: rig.recorded() == ["git_pull"])
    rig.operator.send("incoming/drive-values", {"x": 0, "z": 0.5}, qos=0)
    assert until(lambda: rig.mcu.moving(began))
    assert until(lambda: not rig.mcu.moving(began)), "it stops without further commands"
    status = Path(f"/proc/{rig.processes()['mqtt_bridge']}/status").read_text()
    assert "Seccomp:\t2" in status
    assert "CapBnd:\t0000000000000000" in status
    assert not [line for line in rig.log.read_text().splitlines() if "ERROR" in line or "not permitted" in line]
