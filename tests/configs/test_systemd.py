"""The units confine a robot; tests/ext/install/life has it in one."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.kit import npm
from tests.support import ROOT

UNITS = ROOT / "configs" / "systemd"
NAMES = ("pebble", "pebble-update", "pebble-web", "pebble-record", "pebble-hub", "pebble-gateway")
ROBOT, UPDATE, *OTHERS = (UNITS / f"{name}.service" for name in NAMES)
MOST_EXPOSED = 16  # tenths, of systemd-analyze
#: What every unit says, whatever systemd-analyze makes of the rest.
CONFINED = {
    "NoNewPrivileges": ["yes"],
    "CapabilityBoundingSet": [],
    "AmbientCapabilities": [],
    "ProtectSystem": ["strict"],
    "ProtectHome": ["yes"],
    "ProtectProc": ["invisible"],
    "PrivateTmp": ["yes"],
    "PrivateMounts": ["yes"],
    "MemoryDenyWriteExecute": ["yes"],
    "LimitCORE": ["0"],
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

units = pytest.mark.parametrize("unit", [ROBOT, UPDATE, *OTHERS], ids=lambda path: path.stem)


def service(unit: str) -> dict[str, list[str]]:
    """Return every value of each key of [Service], as systemd reads them: an empty one takes the earlier ones back."""
    found: dict[str, list[str]] = defaultdict(list)
    section = ""
    for line in unit.replace("\\\n", " ").splitlines():
        text = line.strip()
        if text.startswith("["):
            section = text
        elif section == "[Service]" and "=" in text and not text.startswith(("#", ";")):
            key, _, value = (part.strip() for part in text.partition("="))
            found[key] = [*found[key], value] if value else []
    return dict(found)


@pytest.fixture
def analyze() -> Callable[..., subprocess.CompletedProcess[str]]:
    if shutil.which("systemd-analyze") is None:
        pytest.skip("needs systemd-analyze (apt install systemd)")

    def run(*arguments: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(["systemd-analyze", *arguments], capture_output=True, text=True, check=False, timeout=60)

    return run


@units
def test_every_unit_confines(unit: Path) -> None:
    keys = service(unit.read_text())
    expected = {**CONFINED, "UMask": ["0022"]} if unit == UPDATE else CONFINED  # others run what it installs
    assert {key: keys.get(key) for key in expected} == expected
    assert keys["SystemCallFilter"][0] == "@system-service"
    assert keys["SystemCallFilter"][1].startswith("~@privileged @resources")


def test_the_robots_unit_leaves_what_a_robot_needs() -> None:
    keys = service(ROBOT.read_text())
    assert {key: keys.get(key) for key in ROBOTS_OWN} == ROBOTS_OWN
    assert keys["SystemCallFilter"][2:] == ["@memlock sched_setaffinity sched_setscheduler setpriority"]
    assert not {"ProcSubset", "PrivateIPC", "PrivateDevices", "PrivateNetwork"} & keys.keys()


def test_every_device_that_may_be_plugged_in_later_has_its_driver_loaded_before() -> None:
    text = ROBOT.read_text()
    devices = [value.removesuffix(" rw") for value in service(text)["DeviceAllow"]]
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
    if not npm.MODULES.exists():
        pytest.skip("needs Node.js: make check installs it")
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


def test_polkit_allows_the_commands_that_the_unit_recommends_and_only_the_robot(tmp_path: Path) -> None:
    lines = re.findall(r'^# +(\["systemctl".*\])$', ROBOT.read_text(), re.MULTILINE)  # as the unit's comment gives them
    reboot, restart, update = map(json.loads, lines)
    assert reboot == ["systemctl", "--no-ask-password", "reboot"]
    jobs = [{"verb": command[-2], "unit": command[-1]} for command in (restart, update)]
    asked = [(REBOOT, {}), (f"{REBOOT}-multiple-sessions", {}), *((RESTART, job) for job in jobs)]
    users = ("pebble", "pebble-web", "pebble-update", "")
    answers = granted(tmp_path, *((user, *one) for user in users for one in asked))
    assert answers == [True] * 4 + [False] * 12
    assert jobs[1]["unit"] == UPDATE.name


def test_polkit_allows_the_robot_nothing_else(tmp_path: Path) -> None:
    others = [
        *({"verb": verb, "unit": "pebble.service"} for verb in ("start", "stop", "set-property", "")),
        *({"verb": "restart", "unit": unit} for unit in ("ssh.service", "pebble-update.service")),
        {"verb": "start", "unit": "pebble.service.d"},
        {"verb": "stop", "unit": "pebble-update.service"},
        {},
    ]
    actions = (
        f"{REBOOT}-ignore-inhibit",
        "org.freedesktop.systemd1.manage-unit-files",
        "org.freedesktop.policykit.exec",
    )
    cases = [*(("pebble", RESTART, details) for details in others), *(("pebble", action, {}) for action in actions)]
    assert granted(tmp_path, *cases) == [False] * len(cases)


def test_the_update_writes_the_checkout_only_and_installs_what_the_lock_names() -> None:
    keys = service(UPDATE.read_text())
    assert keys["User"] == ["pebble-update"]
    assert keys["ReadWritePaths"] == ["/opt/pebble"]
    packages, own = (line for line in keys["ExecStart"] if "pip install" in line)
    assert "sh /opt/pebble/tools/locked.sh robot >/tmp/robot.txt;" in packages
    assert packages.endswith("pip install --require-hashes -r /tmp/robot.txt'")
    assert own == "/opt/pebble/venv/bin/pip install --no-deps --no-build-isolation /opt/pebble"
