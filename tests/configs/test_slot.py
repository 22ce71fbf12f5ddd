"""pebble-slot starts the slot that is proven, tries another one only while it can count, and never fails a start."""

from __future__ import annotations

import os
import stat
from collections.abc import Callable
from pathlib import Path

import pytest

from pebble.extensions.operator.places import Places
from tests.kit.slots import ID, TRIAL, Seen, Slots

UNPROVEN = "0.3.0 it was not proven in its starts"
#: slots that are whole, the active one, the trial, and what then is to be seen
CHOICES = {
    "no trial": ("ab", "a", "", Seen("a", "a", "", "")),
    "the other one is active": ("ab", "b", "", Seen("b", "b", "", "")),
    "first start of a trial": ("ab", "a", TRIAL, Seen("b", "a", f"b 1 0.3.0 {ID}", "")),
    "last start of a trial": ("ab", "a", f"b 1 0.3.0 {ID}", Seen("b", "a", f"b 0 0.3.0 {ID}", "")),
    "no start left": ("ab", "a", f"b 0 0.3.0 {ID}", Seen("a", "a", "", UNPROVEN)),
    "a trial of a slot that is not whole": ("a", "a", TRIAL, Seen("a", "a", "", UNPROVEN)),
    "proven before a power cut": ("ab", "b", TRIAL, Seen("b", "b", "", "")),
    "the active one is damaged": ("b", "a", "", Seen("b", "a", "", "")),
    "none is whole": ("", "a", "", Seen("a", "a", "", "")),
    "active points anywhere": ("ab", "../../etc", "", Seen("a", "../../etc", "", "")),
    **{
        f"unreadable: {text[:20]!r}": ("ab", "a", text, Seen("a", "a", "", ""))
        for text in (
            *("b 2 0.3.0", f"c 2 0.3.0 {ID}", f"b 22 0.3.0 {ID}", f"b 2 0.3.0 {ID}0", f"b 2 0.3.0 {ID} more"),
            *(f"b 2 $(reboot) {ID}", "b 2 0.3.0 9f2c61d07be45a1G", f"b 2 0/3 {ID}", f"b\0 2 0.3.0 {ID}", "* * * *"),
        )
    },
}
#: the proof's result and exit status, and what then is to be seen; the trial began in b
RESULTS = {
    "proven": ("success", "42", Seen("b", "b", "", ""), False),
    "undecided": ("success", "43", Seen("b", "a", "", ""), True),
    "disproven": ("exit-code", "1", Seen("b", "a", "", "0.3.0 it did not prove itself: exit-code 1"), True),
    "hung": ("timeout", "KILL", Seen("b", "a", "", "0.3.0 it did not prove itself: timeout KILL"), True),
    "stopped with the robot": ("success", "0", Seen("b", "a", f"b 1 0.3.0 {ID}", ""), False),
}


@pytest.mark.parametrize(("whole", "active", "trial", "expected"), CHOICES.values(), ids=CHOICES)
def test_choose(tmp_path: Path, whole: str, active: str, trial: str, expected: Seen) -> None:
    slots = Slots(tmp_path, whole, active, trial)
    done = slots.run("choose")
    assert (done.returncode, slots.seen()) == (0, expected), done.stderr


@pytest.mark.parametrize(("result", "status", "expected", "restarts"), RESULTS.values(), ids=RESULTS)
def test_a_proof_decides(tmp_path: Path, result: str, status: str, expected: Seen, restarts: bool) -> None:
    slots = Slots(tmp_path, trial=TRIAL)
    slots.run("choose")
    assert slots.judged(result, status).returncode == 0
    assert slots.seen() == expected
    assert slots.asked.exists() == restarts


def test_the_proof_of_another_start_decides_nothing(tmp_path: Path) -> None:
    slots = Slots(tmp_path, trial=TRIAL)
    slots.run("choose")
    slots.run("judge")
    slots.run("choose")
    assert slots.decide("success", "42").returncode == 0
    assert slots.seen() == Seen("b", "a", f"b 0 0.3.0 {ID}", "")


def test_back_and_forth(tmp_path: Path) -> None:
    slots = Slots(tmp_path, trial=TRIAL)
    assert slots.run("back").returncode == 0
    assert slots.seen() == Seen("", "b", "", "")
    slots.run("choose")
    assert slots.run("back").returncode == 0
    assert slots.seen() == Seen("b", "a", "", ""), "what runs goes on"
    (Places(tmp_path).slots / "b" / ".complete").unlink()
    done = slots.run("back")
    assert (done.returncode, done.stderr) == (1, "pebble-slot: slot b is not whole, so a stays\n")


@pytest.mark.parametrize(
    ("make", "why"),
    [
        (os.mkfifo, "has more than plain files"),
        (lambda path: path.symlink_to("/etc/hostname"), "has more than plain files"),
        (lambda path: (path.touch(), os.truncate(path, 200 << 20)), "it cannot be copied"),
    ],
)
def test_a_release_has_small_plain_files_only(tmp_path: Path, make: Callable[[Path], object], why: str) -> None:
    slots, release = Slots(tmp_path), tmp_path / "release"
    release.mkdir()
    for name in ("RELEASE.json", "pebble_robot-1-py3-none-any.whl"):
        (release / name).touch()
    make(release / "robot.txt")
    done = slots.run("take", str(release))
    assert (done.returncode, why in done.stderr) == (1, True), done.stderr
    assert not (Places(tmp_path).slots / "release.new").exists()


def test_commands_run_from_the_active_slot_or_the_one_that_is_whole(tmp_path: Path) -> None:
    slots = Slots(tmp_path, active="b")
    assert slots.run("which").stdout == f"{tmp_path}/opt/pebble/b\n"
    (Places(tmp_path).slots / "b" / "bin" / "python3").unlink()
    assert slots.run("which").stdout == f"{tmp_path}/opt/pebble/a\n"
    (Places(tmp_path).slots / "a" / ".complete").unlink()
    assert slots.run("which").returncode == 1


def test_what_it_makes_can_be_read_by_the_robots_user(tmp_path: Path) -> None:
    """Under a unit with UMask=0077 it would start nothing."""
    slots = Slots(tmp_path, trial=TRIAL)
    slots.run("choose")
    places = Places(tmp_path)
    assert stat.S_IMODE(places.current_slot.parent.stat().st_mode) == 0o755
    assert stat.S_IMODE(slots.trial.stat().st_mode) == 0o644
