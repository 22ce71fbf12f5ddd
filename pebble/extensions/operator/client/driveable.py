"""The facts in a robot's status: can it be driven, and stopped, and what waits while it is driven. Pure."""

from typing import Any, NamedTuple

from pebble.contract import STATUS, codec
from pebble.errors import PayloadError

_STATUS_BYTES = 64 * 1024
_WHY = 300  # characters


class Driveable(NamedTuple):
    """``state`` is ``yes``, ``no`` or ``unknown``; ``why`` is the robot's text, perhaps not printable."""

    state: str
    why: str = ""

    @property
    def doubt(self) -> str:
        """The reason in words; empty if it can be driven."""
        if self.state == "yes":
            return ""
        what = "CANNOT BE DRIVEN OR STOPPED" if self.state == "no" else "not known whether its motors obey"
        return f"{what}: {self.why or 'it does not say why'}"


def driveable_of(status: bytes) -> Driveable | None:
    """Return the value in an ``outgoing/status``.

    None: it is not there, as for an older robot, or one without motors.
    """
    section = _value(status).get("driveable")
    if not isinstance(section, dict) or section.get("state") not in ("yes", "no", "unknown"):
        return None
    why = section.get("why")
    return Driveable(section["state"], why[:_WHY] if isinstance(why, str) else "")


def is_held(status: bytes, program: str) -> bool:
    """True if that program is requested, and waits while people drive over a thin link."""
    section: Any = _value(status)
    for level in ("services", program, "state"):
        section = section.get(level) if isinstance(section, dict) else None
    return bool(section == "held")


def _value(status: bytes) -> dict[str, Any]:
    try:
        value: dict[str, Any] = codec.decode(STATUS, status).value if len(status) <= _STATUS_BYTES else {}
    except PayloadError:
        return {}
    return value
