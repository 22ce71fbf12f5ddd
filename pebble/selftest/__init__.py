"""Tests a robot that runs, end to end; and packs what others need to repair or to restore it."""

from pebble.check_result import CheckResult, State
from pebble.client.robot_view import RobotView


def ok(text: str) -> CheckResult:
    return CheckResult(State.OK, "", text)


def failed(text: str, fix: str) -> CheckResult:
    return CheckResult(State.FAILED, "", text, fix)


def skipped(why: str, fix: str = "") -> CheckResult:
    """``why`` completes "skipped because"; ``fix``: what would let the check be made."""
    return CheckResult(State.SKIPPED, "", why, fix)


def why_not_free(view: RobotView) -> str:
    """A test takes nothing from people and scripts: who has the robot, or has stopped it; empty if it is free."""
    if view.stopped_by is not None:
        return f"it is stopped by {view.stopped_by.by or 'unknown'}, which only a person ends"
    if view.autonomy is not None and view.autonomy.running:
        return f"the script {view.autonomy.file} is running"
    return f"{view.control.who} drives it" if view.control.who else ""
