"""Whatever pebble-slot is killed in, and whatever its disk does: a start finds a slot, and never an unproven one."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path

import pytest

from tests.kit.slots import ID, TRIAL, Seen, Slots
from tests.small_disk import SmallDisk

#: command, the proof's result and status, and which slots may be active at the end
COMMANDS = {
    "choose": ("choose", "", "", "a"),
    "proven": ("settle", "success", "42", "ab"),
    "disproven": ("settle", "exit-code", "1", "a"),
    "undecided": ("settle", "success", "43", "a"),
    "back": ("back", "", "", "ab"),
}


@pytest.mark.parametrize("when", ["BEFORE", "AFTER"])
@pytest.mark.parametrize(("command", "result", "status", "active"), COMMANDS.values(), ids=COMMANDS)
def test_a_kill_at_any_of_its_steps(
    tmp_path: Path, when: str, command: str, result: str, status: str, active: str
) -> None:
    proof = {"SERVICE_RESULT": result, "EXIT_CODE": "exited", "EXIT_STATUS": status}

    def killed_at(step: int) -> tuple[Slots, int]:
        slots = Slots(tmp_path / str(step), trial=TRIAL)
        slots.run("choose")
        slots.run("judge")
        return slots, slots.run_counted(command, **proof, **{when: str(step)}).returncode

    unharmed, _ = killed_at(0)
    steps = range(1, len(unharmed.calls.read_text().split()) + 1)
    kills = 0
    for step in steps:
        slots, code = killed_at(step)
        kills += code == -signal.SIGKILL
        assert slots.run("choose").returncode == 0
        seen = slots.seen()
        assert seen.active in active, (step, seen)
        assert seen.current == seen.active or seen.trial.startswith("b 0 "), (step, seen)
        for _ in range(3):
            slots.run("choose")
        assert slots.seen() == Seen(seen.active, seen.active, "", slots.seen().refused), step
    assert kills >= len(steps) - 2, "two programs of a pipe may count as one"


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[SmallDisk]:
    if os.geteuid() != 0:
        pytest.skip("needs root: a small file system")
    (tmp_path / "var/lib").mkdir(parents=True)
    disk = SmallDisk(tmp_path / "var/lib/pebble-update")
    disk.mount("mode=755")
    yield disk
    disk.close()


@pytest.mark.parametrize("fault", [SmallDisk.full, SmallDisk.read_only], ids=["full", "read-only"])
def test_what_cannot_be_counted_is_not_tried(
    tmp_path: Path, disk: SmallDisk, fault: Callable[[SmallDisk], AbstractContextManager[None]]
) -> None:
    slots = Slots(tmp_path, trial=TRIAL)
    with fault(disk):
        for _ in range(3):
            done = slots.run("choose")
            assert (done.returncode, slots.seen()) == (0, Seen("a", "a", TRIAL, "")), done.stderr
        assert "the trial of 0.3.0 cannot be counted, so a starts" in done.stderr
    slots.run("choose")
    assert slots.seen() == Seen("b", "a", f"b 1 0.3.0 {ID}", ""), "counted again"
    with fault(disk):
        slots.judged("exit-code", "1")
        slots.run("choose")
        assert slots.seen().current == "a"
