"""What each robot costs of its board's memory, measured in the real MicroPython."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from pebble.extensions.install.flash.boards import FIRMWARE, Firmware
from pebble.extensions.install.flash.sources import main_file, modules
from tests.firmware.micropython import SCRIPTS, compile_file, compile_module, run
from tests.firmware.names import cost

#: What the robots on a serial line find on their board: MicroPython's official image, or one with select in it.
STOCK, FULL = "official image", "image with select"
#: And on an ESP8266: the official image with a ROM file system, from which code runs in place, or the plain one.
ROM, PLAIN = "image with ROMFS", "plain image"
#: The same, at the level at which senders have names.
NAMED = "image with ROMFS, named"
#: Modules that are never loaded there.
_UNUSED = {STOCK: ("usb",), FULL: ("console", "uart"), ROM: ("names",), PLAIN: ("names",), "": ("names",)}
_SCRIPTS = ("board", "net", "workload_serial", "workload_network", "heap")
_DESCRIBED = ("goob_imu",)  # by pebble_serial_v1
_ENOUGH_S = 300.0  # a minute of its own time takes 5 s, and whatever `make test` leaves it of the processors
_HEAP = 64 * 1024  # to start with: the smaller, the quicker it is searched for garbage
_SETTINGS = {
    "wifi": {"ssid": "Lab", "password": "geheim123"},
    "mqtt": {"host": "broker.lab", "port": 1883, "username": "ann", "password": "geheim", "tls": False},
}


@dataclass(frozen=True)
class Case:
    """One robot on one kind of image."""

    robot: str
    image: str = ""

    def __str__(self) -> str:
        return f"{self.robot}, {self.image}" if self.image else self.robot

    @property
    def in_place(self) -> bool:
        """Whether its code runs from flash."""
        return self.image in (ROM, NAMED)

    @property
    def firmware(self) -> Firmware:
        return FIRMWARE[self.robot]


SMALL, MIDDLE = 12 * 1024, 24 * 1024
#: Most bytes of heap that a robot may need, with its code; None: only reported.
LIMITS: dict[Case, int | None] = {
    Case("benjr", NAMED): MIDDLE,  # first, to be measured always: 301 names instead of 300 cost 2 KB
    Case("benjr", ROM): MIDDLE,
    Case("minilamp"): None,  # its board has hundreds of kilobytes
    Case("benjr", PLAIN): None,
    **{Case(robot, image): SMALL for robot in ("goob", "fred", *_DESCRIBED) for image in (STOCK, FULL)},
}
CASES = tuple(LIMITS)


@dataclass(frozen=True)
class Cost:
    """Bytes."""

    files: int  # the .mpy files in flash
    baseline: int  # what the stand-ins take, in none of the rest
    names: int  # of the code, on the board: see names.py
    imported: int  # heap once the code is loaded
    built: int  # and the robot is made
    starting: int  # the most until then, with the garbage of loading one module or of making the robot
    live: int  # the most that was in use between two turns
    peak: int  # and with all that one turn allocates
    peak_at: str  # when that was
    turns: int


def measure(case: Case, folder: Path) -> Cost:
    """Run the robot for a minute. AssertionError if it fails."""
    folder = folder / re.sub(r"\W+", "-", str(case))
    root, code = folder / "root", folder / ("rom" if case.in_place else "root")
    files = modules(case.firmware)
    if not folder.exists():
        _fill(root, code, case, files)
    done = run(root, root / "start.py", heap=_HEAP, timeout_s=_ENOUGH_S)
    assert done.returncode == 0, done.stdout + done.stderr
    figures = json.loads(done.stdout.splitlines()[-1])
    loaded = [(code / file).with_suffix(".mpy") for file in _loaded(case, files)]
    names = cost(loaded, case.firmware.board.port, in_place=case.in_place)
    for figure in ("imported", "built", "starting", "live", "peak"):
        figures[figure] += names - _names_here(done.stdout, in_place=case.in_place)
    size = sum((code / file).with_suffix(".mpy").stat().st_size for file in files)
    return Cost(files=size + main_file(case.firmware).stat().st_size, names=names, **figures)


def _names_here(printed: str, *, in_place: bool) -> int:
    """What the robot's names took in this interpreter, by micropython.qstr_info() before and after."""
    found = re.findall(r"n_str_data_bytes=(\d+), n_total_bytes=(\d+)", printed)
    (text_before, before), (text_after, after) = ((int(text), int(total)) for text, total in found)
    return after - before - (text_after - text_before if in_place else 0)


def _loaded(case: Case, files: list[Path]) -> list[Path]:
    return [file for file in files if file.stem not in _UNUSED.get(case.image, ())]


def _fill(root: Path, code: Path, case: Case, files: list[Path]) -> None:
    root.mkdir(parents=True)
    for file in files:
        compile_module(case.firmware, file, code)
    if code != root:
        build = [sys.executable, "-m", "mpremote", "romfs", "--output", str(root / "rom.romfs"), "build", str(code)]
        subprocess.run(build, check=True, stdout=subprocess.DEVNULL)
    for name in _SCRIPTS:  # compiled, so that no compiler needs memory at the start
        compile_file(SCRIPTS / f"{name}.py", root / f"{name}.mpy")
    # with a ROM file system, that is the working folder
    (root / "start.py").write_text("import sys\nsys.path.append('/')\nfrom heap import turn\n")
    workload = "workload_serial" if case.firmware.is_report else "workload_network"
    settings = {} if case.firmware.is_report else {**_SETTINGS, "robot": {"id": case.robot}}
    if case.image == NAMED:
        settings["security"] = {"level": "named", "strangers": "free"}
    names = [".".join(file.with_suffix("").parts) for file in _loaded(case, files)]
    names.sort(key=lambda name: name == f"{case.robot}.robot")  # last: it needs all others
    case_json = {
        "modules": names,
        "robot": case.robot,
        "workload": workload,
        "stock": case.image == STOCK,
        "described": case.robot in _DESCRIBED,
        "settings": settings,
        "by": "by/page-1/" if case.image == NAMED else "",
    }
    (root / "case.json").write_text(json.dumps(case_json))
