"""Every module of every robot compiles for its board and fits onto it; the pure parts pass in the real MicroPython.

And the loop of every board.
"""

from __future__ import annotations

import ast
import json
import runpy
import shutil
import sys
from collections import defaultdict
from itertools import pairwise
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

from pebble.extensions.install.flash.boards import FIRMWARE, SAMD21
from pebble.extensions.install.flash.on_board import MPY_VERSION
from pebble.extensions.install.flash.sources import firmware_folder, modules
from pebble.extensions.lab.simulation.bodies import body_of
from pebble.extensions.lab.simulation.micropython.board import Board
from pebble.extensions.lab.simulation.micropython.clock import VirtualClock
from tests.firmware.micropython import SCRIPTS, compile_all, compile_module, run
from tests.support import ROOT

pytestmark = pytest.mark.computing


#: Bytes of the file system on a XIAO SAMD21: 256 KB of flash less 8 for the boot loader and 184 for MicroPython.
SMALLEST_DISK = 64 * 1024

#: Modules of the official MicroPython for the XIAO SAMD21, which is a small one. ports/samd/mcu/samd21/mpconfigmcu.h:
#: MICROPY_CONFIG_ROM_LEVEL_BASIC_FEATURES, and SAMD21_EXTRA_FEATURES only where MICROPY_HW_CODESIZE is 248 KB; on a
#: XIAO it is 184. The type stubs and the interpreter in Node.js are bigger ones, so neither notices.
HAS = {
    *("array", "binascii", "gc", "io", "json", "machine", "math", "micropython"),
    *("os", "random", "struct", "sys", "time"),
}
#: Names of builtin methods and functions that only bigger images have.
LACKS = {"buffer", "center", "crc32", "deque", "OrderedDict", "partition", "rpartition", "splitlines", "hashlib"}
#: Loaded where there is more; the robots have something else otherwise.
FOR_BIGGER_IMAGES = {Path("common/usb.py")}


@pytest.mark.parametrize("robot", FIRMWARE)
def test_a_robots_modules_compile_for_its_board(robot: str, tmp_path: Path) -> None:
    firmware = FIRMWARE[robot]
    compiled = [compile_module(firmware, module, tmp_path) for module in modules(firmware)]
    heads = {file.read_bytes()[:4] for file in compiled}
    # version; sub-version and architecture count for native code only, and there is none; bits of a small integer
    assert heads == {bytes((ord("M"), MPY_VERSION[0], 0, 31))}
    assert sum(file.stat().st_size for file in compiled) < SMALLEST_DISK / 2


def test_every_file_belongs_to_a_robot_and_a_robot_gets_nothing_that_it_does_not_import() -> None:
    used = {module for firmware in FIRMWARE.values() for module in modules(firmware)}
    used |= {Path(name, "main.py") for name in FIRMWARE}
    there = {path.relative_to(firmware_folder()) for path in firmware_folder().glob("*/*.py")}
    assert there - used == set()
    names = {module.name for module in modules(FIRMWARE["goob"])}
    assert {"robot.py", "pins.py", "lines.py", "drv8833.py"} <= names
    assert not {"mqtt.py", "wifi.py", "frames.py"} & names


def test_nothing_that_a_small_image_lacks() -> None:
    robots = [firmware for firmware in FIRMWARE.values() if firmware.board is SAMD21]
    for module in {module for firmware in robots for module in modules(firmware)} - FOR_BIGGER_IMAGES:
        imported, names = set(), set()
        for node in ast.walk(ast.parse((firmware_folder() / module).read_text())):
            if isinstance(node, ast.Attribute):
                names.add(node.attr)
            elif isinstance(node, ast.Import | ast.ImportFrom):
                names |= {alias.name for alias in node.names}
                found = (
                    [node.module or ""] if isinstance(node, ast.ImportFrom) else [alias.name for alias in node.names]
                )
                imported |= {name.partition(".")[0] for name in found}
        assert imported - {"common", "wifi", *FIRMWARE} <= HAS, module
        assert not LACKS & names, module


PURE = Path(__file__).parent / "pure"


def test_the_pure_parts_pass_in_micropython(tmp_path: Path) -> None:
    root, files = compile_all(tmp_path), sorted(PURE.glob("test_*.py"))
    for file in files:
        shutil.copy(file, root)
    (root / "vectors").mkdir()
    shutil.copy(ROOT / "tests" / "vectors" / "commands.json", root / "vectors")
    (root / "modules.json").write_text(json.dumps([file.stem for file in files]))
    done = run(root, SCRIPTS / "run_tests.py")
    assert done.returncode == 0, done.stdout + done.stderr
    ran = [json.loads(line) for line in done.stdout.splitlines() if line.startswith('["test_')]
    assert "".join(f"{module}.{test}: {error}\n" for module, test, error in ran if error) == ""
    assert len(ran) == sum(file.read_text().count("\ndef test_") for file in files)


# -- the loop of every board


class WasReset(BaseException):
    """machine.reset() does not return."""


def looped(monkeypatch: pytest.MonkeyPatch, **errors: BaseException | type[BaseException]) -> list[Any]:
    """Run the loop with a robot whose third step fails, and ``errors`` of ``stop`` or ``sleep_ms``; return calls."""
    board = Mock()
    board.micropython.const = int
    board.robot.port = None
    board.robot.step.side_effect = (None, None, MemoryError)
    board.robot.stop.side_effect = errors.get("stop")
    board.time.sleep_ms.side_effect = errors.get("sleep_ms")
    board.machine.reset.side_effect = WasReset
    for name in ("machine", "time", "micropython"):
        monkeypatch.setitem(sys.modules, name, getattr(board, name))
    loop = runpy.run_path(str(ROOT / "firmware" / "common" / "run.py"))
    with pytest.raises(KeyboardInterrupt if "sleep_ms" in errors else WasReset):
        loop["run"](lambda _settings: board.robot, {})
    return [(name.rpartition(".")[2], *arguments) for name, arguments, _ in board.mock_calls]


@pytest.mark.parametrize("errors", [{}, {"stop": MemoryError}])
def test_a_robot_that_fails_stops_and_starts_anew_also_if_it_cannot_stop(
    monkeypatch: pytest.MonkeyPatch, errors: dict[str, Any]
) -> None:
    calls = looped(monkeypatch, **errors)
    assert calls[:4] == [("kbd_intr", 3), ("sleep_ms", 1000), ("kbd_intr", -1), ("WDT",)], "Ctrl-C works until then"
    assert calls[4:] == [("step",), ("feed",)] * 2 + [("step",), ("stop",), ("reset",)]


def test_who_comes_in_by_that_door_finds_no_watchdog(monkeypatch: pytest.MonkeyPatch) -> None:
    assert ("WDT",) not in looped(monkeypatch, sleep_ms=KeyboardInterrupt)


#: Of a golden file, a transcript: milliseconds since the firmware was loaded, a sign, and what happened.
#: ``=`` volts at a pin, or high or low; ``>`` a line from the host; ``<`` a line from the board; ``!`` what motors do
#: from then on, left and right, + = forward; ``.`` the end. A report that says the same as the one before is left out.
#: What the world did is played again, and all of it must come out as it stands there, byte for byte.
Entry = tuple[int, str, str]


def act(board: Board, sign: str, what: str) -> None:
    if sign == ">":
        board.console.type(what.encode() + b"\n")
    elif sign == "=":
        pin, value = what.split()
        if value in ("high", "low"):
            board.set_pin(pin, value == "high")
        else:
            board.set_volts(pin, float(value))


def play(robot: str, script: list[Entry]) -> list[Entry]:
    """Return everything that happens, if that is what the world does. The board has a turn every millisecond."""
    transcript: list[Entry] = []
    clock = VirtualClock()
    board = Board(clock)
    body = body_of(robot, board)
    body.on_motors = lambda now, motors: transcript.append((round(now * 1000), "!", f"{motors[0]:.3f} {motors[1]:.3f}"))
    due: defaultdict[int, list[Entry]] = defaultdict(list)
    for entry in script:
        due[entry[0]].append(entry)
        if entry[0] == 0:
            act(board, *entry[1:])  # before it is switched on
    firmware = board.load(robot, {})
    for now in range(script[-1][0] + 1):
        clock.until(now / 1000)
        for entry in due[now]:
            transcript.append(entry)
            act(board, *entry[1:])
        firmware.step()
        body.end_turn()
        transcript += [(now, "<", line.decode()) for line in board.console.take_output().split(b"\r\n")[:-1]]
    return transcript


@pytest.mark.parametrize(("robot", "period_ms"), [("goob", 20), ("fred", 500)])
def test_the_boards_output_is_exactly_this(robot: str, period_ms: int) -> None:
    golden = (Path(__file__).parent / "golden" / f"{robot}.txt").read_text()
    entries = [(int(line[:5]), line[6], line[8:]) for line in golden.splitlines()]
    transcript = play(robot, [entry for entry in entries if entry[1] in "=>."])
    reports = [entry for entry in transcript if entry[2].startswith("T ")]
    assert {later[0] - one[0] for one, later in pairwise(reports)} == {period_ms}
    for one, later in pairwise(reports):
        if one[2] == later[2]:
            transcript.remove(later)
    assert "".join(f"{ms:5d} {sign} {what}".rstrip() + "\n" for ms, sign, what in transcript) == golden
