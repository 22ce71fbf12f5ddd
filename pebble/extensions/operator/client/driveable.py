"""The part of a robot's status about driving: whether its motors obey, and which programs wait meanwhile. Pure."""

from typing import Any, NamedTuple

from pebble.contract import STATUS, codec
from pebble.errors import PayloadError
from pebble.extensions.operator.client.robot_topics import section_of

_STATUS_BYTES = 64 * 1024
_WHY = 300  # characters
#: The words of the page (``static/ui/fleet/doubt.js``), and those about a stopped robot.
_DRIVEN = {"no": "Cannot be driven", "unknown": "Not known whether it can be driven"}
_STOPPED = {"no": "nothing confirms that its motors stand", "unknown": "it is not known whether its motors stand"}


class Driveable(NamedTuple):
    """The robot's judgement. ``state``: ``yes``, ``no`` or ``unknown``; ``why``: a text, perhaps not printable."""

    state: str
    why: str = ""


def is_cut_off(driveable: Driveable | None) -> bool:
    """True if no command reaches the motors, not even a stop, as the robot says itself."""
    return driveable is not None and driveable.state == "no"


def doubt_of(driveable: Driveable | None, *, stopped: bool = False) -> str:
    """Return why drive commands, or (``stopped``) a stop, may have no effect; empty if the robot has no doubt."""
    if driveable is None or driveable.state == "yes":
        return ""
    words = (_STOPPED if stopped else _DRIVEN)[driveable.state]
    return f"{words}: {driveable.why}" if driveable.why else words


def driveable_of(status: bytes) -> Driveable | None:
    """Return the judgement in the value of an ``outgoing/status``.

    None if there is none, as in the status of an older robot, or one without motors.
    """
    section = _value(status).get("driveable")
    if not isinstance(section, dict) or section.get("state") not in ("yes", "no", "unknown"):
        return None
    why = section.get("why")
    return Driveable(section["state"], why[:_WHY] if isinstance(why, str) else "")


def is_held(status: bytes, program: str) -> bool:
    """True if ``program`` is requested, but waits while a person drives over a thin link."""
    return bool(section_of(_value(status), f"services.{program}").get("state") == "held")


def _value(status: bytes) -> dict[str, Any]:
    try:
        value: dict[str, Any] = codec.decode(STATUS, status).value if len(status) <= _STATUS_BYTES else {}
    except PayloadError:
        return {}
    return value
