"""A robot runs for a minute in the real MicroPython within its board's memory. ``make test THOROUGH=1``: each does."""

from __future__ import annotations

import ast
import functools
import json
import logging
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from pebble.extensions.install.flash.boards import FIRMWARE, Firmware
from pebble.extensions.install.flash.sources import modules
from tests.firmware.micropython import SCRIPTS, compile_file, compile_module, run
from tests.firmware.types import STUBS
from tests.support import some

pytestmark = pytest.mark.computing


log = logging.getLogger(__name__)

#: What the robots on a serial line find on their board: MicroPython's official image, or one with select in it.
STOCK, FULL = "official image", "image with select"
#: And on an ESP8266: the official image with a ROM file system, from which code runs in place; senders may have names.
ROM, NAMED = "image with ROMFS", "image with ROMFS, named"
#: Modules that are never loaded there.
_UNUSED = {STOCK: ("usb",), FULL: ("console", "uart"), ROM: ("names",), "": ("names",)}
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
    """One robot on one kind of image; the most bytes of heap that it may need, with its code, and names of its own."""

    robot: str
    image: str
    limit: int
    most_names: int

    @property
    def in_place(self) -> bool:
        """True if its code runs from flash."""
        return self.image in (ROM, NAMED)

    @property
    def firmware(self) -> Firmware:
        return FIRMWARE[self.robot]

    @property
    def loaded(self) -> list[Path]:
        return [file for file in modules(self.firmware) if file.stem not in _UNUSED.get(self.image, ())]


#: MicroPython keeps each name that its image does not know in memory, in pools, of which each has room for twice as
#: many as the last (py/qstr.c, qstr_add): 301 names instead of 300 cost 2 KB. The interpreter in Node.js knows others.
SMALL, MIDDLE, LARGE = (12 * 1024, 140), (24 * 1024, 300), (46 * 1024, 620)
CASES = (
    Case("benjr", NAMED, *MIDDLE),  # first, to be measured always
    Case("benjr", ROM, *MIDDLE),
    Case("minilamp", "", *LARGE),
    *(Case(robot, image, *SMALL) for robot in ("goob", "fred", *_DESCRIBED) for image in (STOCK, FULL)),
)


@pytest.mark.parametrize("case", some(CASES, len(CASES)), ids=str)
def test_heap(case: Case, tmp_path: Path) -> None:
    root, code = tmp_path / "root", tmp_path / ("rom" if case.in_place else "root")
    install(case, root, code)
    done = run(root, root / "start.py", heap=_HEAP, timeout_s=_ENOUGH_S)
    assert done.returncode == 0, done.stdout + done.stderr
    figures = json.loads(done.stdout.splitlines()[-1])
    compiled = [(code / file).with_suffix(".mpy").read_bytes() for file in case.loaded]
    names = {name for file in compiled for name in names_in(file)} - known(case.firmware.board.port)
    log.info("%s: %s, and %d names", case, figures, len(names))
    assert figures["peak"] <= case.limit, figures
    assert len(names) <= case.most_names
    # else something was not measured
    assert figures["imported"] < figures["built"] <= figures["live"] <= figures["peak"], figures


def install(case: Case, root: Path, code: Path) -> None:
    """Compile the robot's modules into ``code``, and put what measures it into ``root``."""
    root.mkdir(parents=True)
    for file in modules(case.firmware):
        compile_module(case.firmware, file, code)
    if code != root:
        build = [sys.executable, "-m", "mpremote", "romfs", "--output", str(root / "rom.romfs"), "build", str(code)]
        subprocess.run(build, check=True, stdout=subprocess.DEVNULL)
    for name in _SCRIPTS:  # compiled, so that no compiler needs memory at the start
        compile_file(SCRIPTS / f"{name}.py", root / f"{name}.mpy")
    # with a ROM file system, that is the working folder
    (root / "start.py").write_text("import sys\nsys.path.append('/')\nfrom heap import turn\n")
    settings = {} if case.firmware.is_report else {**_SETTINGS, "robot": {"id": case.robot}}
    if case.image == NAMED:
        settings["security"] = {"level": "named", "strangers": "free"}
    names = [".".join(file.with_suffix("").parts) for file in case.loaded]
    names.sort(key=lambda name: name == f"{case.robot}.robot")  # last: it needs all others
    case_json = {
        "modules": names,
        "robot": case.robot,
        "workload": "workload_serial" if case.firmware.is_report else "workload_network",
        "stock": case.image == STOCK,
        "described": case.robot in _DESCRIBED,
        "settings": settings,
        "by": "by/page-1/" if case.image == NAMED else "",
    }
    (root / "case.json").write_text(json.dumps(case_json))


def names_in(mpy: bytes) -> Iterator[str]:
    """The table of names at the beginning of a .mpy file (tools/mpy-tool.py, read_mpy); fixed ones have no text."""
    at = 4

    def number() -> int:
        nonlocal at
        value = 0
        while True:
            byte = mpy[at]
            at += 1
            value = value << 7 | byte & 127
            if not byte & 128:
                return value

    count = number()
    number()  # of constants
    for _ in range(count):
        head = number()
        if not head & 1:
            yield mpy[at : at + (head >> 1)].decode()
            at += (head >> 1) + 1


@functools.cache
def known(port: str) -> frozenset[str]:
    """Names in the image of a port: what its modules define, by their stubs."""
    found: set[str] = set()
    for file in (STUBS / port).rglob("*.pyi"):
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.FunctionDef):
                found.add(node.name)
                found.update(argument.arg for argument in node.args.kwonlyargs)
            elif isinstance(node, ast.ClassDef):
                found.add(node.name)
            elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
                found.add(node.target.id)
        found.update((file.stem, file.parent.name))
    return frozenset(found)
