"""Deliberate bugs in bridge, mirror and what they are made of, and the tests that find each.

Run ``python -m tests.forwarding.mutations [WORDS]``: all, or those whose name contains the words. Each is put into a
copy of the product.
"""

from __future__ import annotations

import re
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
    """``old`` is replaced by ``new`` in ``file``; ``tests`` are to find it."""

    name: str
    file: str
    old: str
    new: str
    tests: str


_F, _UNITS, _LOOPS, _ALL = "pebble/forwarding/", "test_forwarding.py::", "test_cycles.py::", "test_services.py::"
MUTATIONS = (
    Mutation(
        "late commands pass", f"{_F}admission.py", "message.waited_s > subject.waits_s", "False", f"{_UNITS}TestLate"
    ),
    Mutation(
        "late zeros are dropped",
        f"{_F}admission.py",
        " and not _ends_something(subject, message)",
        "",
        f"{_UNITS}TestLate",
    ),
    Mutation(
        "a zero ends nothing",
        "pebble/contract/payloads.py",
        "return not self.moves",
        "return False",
        f"{_UNITS}TestLate",
    ),
    Mutation(
        "lights wait no longer than drive commands",
        "pebble/contract/channels.py",
        'waits_s=_PATIENT_S, override=_serial("lights_solid")',
        'override=_serial("lights_solid")',
        f"{_UNITS}TestLate",
    ),
    Mutation(
        "commands of any size pass",
        f"{_F}admission.py",
        "len(message.payload) > MAX_COMMAND_BYTES and",
        "False and",
        f"{_UNITS}TestAdmission",
    ),
    Mutation(
        "unknown flags have no bound",
        f"{_F}admission.py",
        "or len(self._flags) < MAX_UNKNOWN_FLAGS:",
        "or True:",
        f"{_UNITS}TestAdmission",
    ),
    Mutation(
        "a live stop that asks to be retained is refused",
        f"{_F}forwarder.py",
        "elif not here.window.is_old_stop(message):",
        "elif False:",
        f"{_ALL}TestStops",
    ),
    Mutation(
        "a retained stop passes",
        f"{_F}forwarder.py",
        "elif not here.window.is_old_stop(message):",
        "else:",
        f"{_ALL}TestStops",
    ),
    Mutation(
        "retained messages of a slow link end no later",
        f"{_F}retained_window.py",
        "self._stops_until = max(self._until, self._newest_at + INITIAL_SYNC_S)",
        "self._stops_until = self._until",
        f"{_UNITS}TestStops",
    ),
    Mutation(
        "stops are old as long as others are retained",
        f"{_F}retained_window.py",
        "min(max(now + INITIAL_SYNC_S, until), end)",
        "max(now + INITIAL_SYNC_S, until)",
        f"{_UNITS}TestStops",
    ),
    Mutation(
        "a lost connection is not noted",
        f"{_F}side.py",
        "            self.subscribing()  # the transport does so at the next connection\n",
        "",
        f"{_UNITS}TestStops",
    ),
    Mutation(
        "a lost connection synchronizes nothing",
        f"{_F}side.py",
        "self.restarted = True\n            self._lost_at",
        "self._lost_at",
        f"{_ALL}TestFlags",
    ),
    Mutation(
        "flags pass without a decision",
        f"{_F}retained_topics.py",
        "if subject.kind in self._both_ways:\n                drop",
        "if False:\n                drop",
        f"{_ALL}TestFlags",
    ),
    Mutation(
        "what has waited for the gate is lost",
        f"{_F}retained_topics.py",
        "self._publish(Side.REMOTE, subject, message, forward)",
        "pass",
        f"{_ALL}TestOutage",
    ),
    Mutation(
        "a change during an outage counts as any other",
        f"{_F}retained_topics.py",
        "other_away=not self._sides[side.other].connected",
        "other_away=False",
        f"{_ALL}TestFlags",
    ),
    Mutation(
        "the winner's old value counts after an outage",
        f"{_F}reconciliation.py",
        "if topic in self._overtaken or topic in self._newer:",
        "if False:",
        f"{_ALL}TestFlags",
    ),
    Mutation(
        "a probe that comes back where it was sent proves a cycle",
        f"{_F}cycles.py",
        "if sent_to is side.other:",
        "if sent_to is not None:",
        f"{_LOOPS}TestCycles",
    ),
    Mutation(
        "stops circulate",
        f"{_F}cycles.py",
        "return Finding.CIRCULATES if self._repeats_stop(",
        "return Finding.PASS if self._repeats_stop(",
        f"{_LOOPS}TestOthers",
    ),
    Mutation(
        "what runs something may run twice",
        f"{_F}publisher.py",
        "if subject.runs or (not",
        "if (not",
        f"{_LOOPS}TestOthers",
    ),
    Mutation(
        "commands are not probed again",
        f"{_F}publisher.py",
        "        if self._cycles.closed_ways:\n            for",
        "        if False:\n            for",
        f"{_LOOPS}TestSeveralBridges",
    ),
    Mutation(
        "what asks to be retained passes",
        f"{_F}routing.py",
        "(message.retain or message.retain_requested):\n        return Drop.STALE",
        "message.retain:\n        return Drop.STALE",
        f"{_ALL}TestOneShots",
    ),
    Mutation(
        "scripts of others drive",
        f"{_F}signatures.py",
        "return None if drive.moves else",
        "return payload if drive.moves else",
        f"{_UNITS}TestSignatures",
    ),
    Mutation(
        "the newest event is dropped",
        f"{_F}event_buffer.py",
        "self._waiting.popleft()\n            self._counters",
        "self._waiting.pop()\n            self._counters",
        f"{_ALL}TestOutage",
    ),
    Mutation(
        "a bridge does not ask whether its sides are one",
        "services/mqtt_bridge/service.py",
        "if not self._same_broker.possible:",
        "if True:",
        f"{_ALL}TestOneBroker",
    ),
    Mutation(
        "a shut gate is not checked again",
        f"{_F}service.py",
        "        self.check_later()\n",
        "",
        f"{_ALL}TestOneBroker",
    ),
)


def found_by(mutation: Mutation, tree: Path, tests: str) -> str:
    """The first test that fails in a copy of ``tree`` with this bug; empty if none does."""
    with tempfile.TemporaryDirectory(prefix="pbl") as folder:
        for name in _COPIED:
            ignored = shutil.ignore_patterns("__pycache__")
            shutil.copytree(tree / name, Path(folder, name), symlinks=True, ignore=ignored)
        shutil.copy(tree / "pyproject.toml", folder)
        file = Path(folder, mutation.file)
        text = file.read_text()
        assert text.count(mutation.old) == 1, f"{mutation.file} has changed: {mutation.name}"
        file.write_text(text.replace(mutation.old, mutation.new))
        command = [
            sys.executable,
            "-m",
            "pytest",
            "-x",
            "-q",
            "-p",
            "no:cacheprovider",
            "-p",
            "no:xdist",
            *tests.split(),
        ]
        ran = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    failed = re.search(r"^(?:FAILED|ERROR) (\S+)", ran.stdout, re.MULTILINE)
    assert failed or ran.returncode == 0, ran.stdout[-2000:] + ran.stderr
    return failed[1] if failed else ""


def main() -> int:
    missed = 0
    for mutation in MUTATIONS:
        if " ".join(sys.argv[1:]) in mutation.name:
            found = found_by(mutation, ROOT, f"tests/forwarding/{mutation.tests}")
            missed += not found
            print(f"{mutation.name}: {f'found by {found}' if found else 'NOT FOUND'}", flush=True)  # noqa: T201
    return missed


if __name__ == "__main__":
    sys.exit(main())
