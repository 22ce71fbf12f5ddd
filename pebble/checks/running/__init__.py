"""Checks of a robot that runs, end to end, from its own side and from its operators'."""

from collections.abc import Iterator
from typing import Any

from pebble.client.robot_topics import section_of
from pebble.client.robot_view import RobotView


def why_not_free(view: RobotView) -> str:
    """Return who has the robot, or has stopped it: a test takes nothing from them. Empty if it is free."""
    if view.stopped_by is not None:
        return f"it is stopped by {view.stopped_by.by or 'unknown'}, which only a person ends"
    if view.autonomy is not None and view.autonomy.running:
        return f"the script {view.autonomy.file} is running"
    return f"{view.control.who} drives it" if view.control.who else ""


def available(capabilities: dict[str, Any]) -> Iterator[str]:
    """Return the sections of a robot's capabilities that are available."""
    return (name for name in capabilities if section_of(capabilities, name).get("available") is True)
