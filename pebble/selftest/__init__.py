"""Tests a robot that runs, end to end; and packs what others need to repair or to restore it."""

from dataclasses import dataclass
from enum import StrEnum

from pebble.client.robot_view import RobotView


class State(StrEnum):
    OK = "ok"
    FAILED = "failed"
    SKIPPED = "skipped"


@dataclass(frozen=True, slots=True)
class Outcome:
    """What one check found; ``fix`` is the command or change that ends a failure."""

    state: State
    text: str
    fix: str = ""


def ok(text: str) -> Outcome:
    return Outcome(State.OK, text)


def failed(text: str, fix: str) -> Outcome:
    return Outcome(State.FAILED, text, fix)


def skipped(why: str, fix: str = "") -> Outcome:
    """``why`` completes "skipped because"; ``fix``: what would let the check be made."""
    return Outcome(State.SKIPPED, why, fix)


def why_not_free(view: RobotView) -> str:
    """A test takes nothing from people and scripts: who has the robot, or has stopped it; empty if it is free."""
    if view.stopped_by is not None:
        return f"it is stopped by {view.stopped_by.by or 'unknown'}, which only a person ends"
    if view.autonomy is not None and view.autonomy.running:
        return f"the script {view.autonomy.file} is running"
    return f"{view.control.who} drives it" if view.control.who else ""
