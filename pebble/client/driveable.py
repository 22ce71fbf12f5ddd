"""What a robot's status says of whether it can be driven, and stopped. Pure."""

from typing import NamedTuple

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
    """The value in an ``outgoing/status``; None: it is not there, as for an older robot, or one without motors."""
    if len(status) > _STATUS_BYTES:
        return None
    try:
        found = codec.decode(STATUS, status).value.get("driveable")
    except PayloadError:
        return None
    if not isinstance(found, dict) or found.get("state") not in ("yes", "no", "unknown"):
        return None
    why = found.get("why")
    return Driveable(found["state"], why[:_WHY] if isinstance(why, str) else "")
