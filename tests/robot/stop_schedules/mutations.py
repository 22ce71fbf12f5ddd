"""Faults put into a copy of the product: each must be found by a few schedules, or the schedules prove nothing."""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

from tests.support import ROOT

_COPIED = ("pebble", "bench", "configs", "firmware", "rig", "services", "simulation", "tests", "tools", "transports")


@dataclass(frozen=True, slots=True)
class Mutation:
    """``old`` is replaced by ``new`` in ``file``; schedules of ``setup`` find it."""

    name: str
    setup: str
    file: str
    old: str
    new: str


_GUARD = "services/serial_mcu_bridge/motion/motor_guard.py"
_LATCH, _ARBITER = "firmware/common/latch.py", "firmware/common/arbiter.py"

MUTATIONS = (
    Mutation("a latch is not restored", "power cut", _GUARD, "if saved is not None:", "if saved is None:"),
    Mutation(
        "a board's latch is not restored", "power cut", "firmware/common/estop.py", "self.latch.restore(saved)", "pass"
    ),
    Mutation(
        "what is not saved yet counts as saved",
        "killed before the state",
        _GUARD,
        "self._saving = self._file.save(self._latch.saved())",
        "self._saved = self._saving = self._saving + 1",
    ),
    Mutation(
        "retained copies pass the bridge",
        "retained stop",
        "pebble/forwarding/forwarder.py",
        "elif not here.window.is_old_stop(message):",
        "else:",
    ),
    Mutation(
        "a reset ignores the count", "two", _LATCH, '"count" if count != self.count else', '"count" if count < 0 else'
    ),
    Mutation("a reset ignores the boot", "power cut", _LATCH, '"boot" if boot != self.boot else', ""),
    Mutation("a latched owner moves for persons", "two", _LATCH, "return moves\n", "return moves and script\n"),
    Mutation("a person's zero does not hold scripts", "two", _ARBITER, "self._held = True\n", "self._held = moves\n"),
    Mutation(
        "a person's zero bars no run",
        "two",
        _ARBITER,
        "if not moves and (final or self._scripted):",
        "if final and moves:",
    ),
    Mutation(
        "a person's zero is dropped at the robot",
        "two",
        "services/serial_mcu_bridge/text/motor_bridge.py",
        "now, drive = self.clock(), received.drive\n",
        "now, drive = self.clock(), received.drive\n        if not drive.moves:\n            return\n",
    ),
    Mutation("a barred run moves", "two", _ARBITER, " or (run > 0 and not newer(run, self.barred)):", ":"),
)


def find(mutation: Mutation, transport: str, schedules: int, seed: int) -> str:
    """What the schedules found in a copy with this fault; empty if nothing."""
    with tempfile.TemporaryDirectory(prefix="pbl") as folder:
        for name in _COPIED:
            shutil.copytree(
                ROOT / name, Path(folder, name), symlinks=True, ignore=shutil.ignore_patterns("__pycache__")
            )
        file = Path(folder, mutation.file)
        text = file.read_text()
        assert text.count(mutation.old) == 1, f"{mutation.file} has changed: {mutation.name}"
        file.write_text(text.replace(mutation.old, mutation.new))
        setup = _second(transport) if mutation.setup == "two" else mutation.setup
        command = [
            *(sys.executable, "-m", "tests.robot.stop_schedules", "--transport", transport, "--setup", setup),
            *("--schedules", str(schedules), "--seed", str(seed), "--first"),
        ]
        ran = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    found = [line.strip() for line in ran.stdout.splitlines() if "VIOLATION" in line]
    assert found or ran.returncode == 0, ran.stderr
    return found[0] if found else ""


def _second(transport: str) -> str:
    return "mirror" if transport == "zenoh" else "two brokers"
