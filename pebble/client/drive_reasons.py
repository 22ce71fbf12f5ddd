"""Why a robot is not driven: the reasons, the order in which they count, and the limits they have in common. Pure.

The page's own reasons are in ``web/static/core/reasons.js``; ``tests/vectors/drive_reasons.json`` is run by both.
"""

from collections.abc import Callable, Sequence
from enum import StrEnum
from typing import NamedTuple

from pebble.contract.payloads import EstopState

SILENT_S = 1.5  # a robot is not called silent before
RESET_S = 0.6  # robots refuse whoever has not paused for 0.5 s after a reset
LATE_S = 0.6  # of a round trip, or of a command: one that takes longer is not sent, or moves nothing
SLOW_S, SLOW_SPEED = 0.3, 0.4  # from this round trip on, the speed is limited


class Code(StrEnum):
    """A reason. Those that only the page has, for example that it is in the background, are not here."""

    BROKER = "broker"
    SILENT = "silent"
    UNSEEN = "unseen"  # whether it is there is not known yet
    STOPPED = "stopped"
    STOPPING = "stopping"  # an emergency stop from here is not over
    RESET = "reset"
    UNKNOWN = "unknown"  # what it can do
    NO_DRIVE = "no-drive"
    LEASE = "lease"  # another person drives it
    LISTENING = "listening"  # whether another person drives it is not known yet
    SCRIPT = "script"
    LATE = "late"


class Situation(NamedTuple):
    """What is known of one robot and of the way to it, at one moment."""

    problem: str = ""  # why there is no connection
    online: bool | None = None  # None: it is not known
    latched: bool = False
    stopping: bool = False
    free_s: float = float("inf")  # since its emergency stop was reset
    published: bool = False  # what it can do
    drives: bool = False
    arbitrates: bool = False  # between scripts and people
    driven: bool = False  # by another person
    listening: bool = False
    script: bool = False
    late_s: float = 0.0


#: Of a terminal, and as far as it has them of the page.
ORDER = tuple(Code)
#: Of the page's server, for what a page has asked of it.
SERVER_ORDER = (Code.BROKER, Code.NO_DRIVE, Code.STOPPED, Code.RESET, Code.SILENT)
#: Of the server, for scripts; a person and a script go together where the robot arbitrates.
SCRIPT_ORDER = (Code.UNSEEN, Code.STOPPED, Code.LEASE)

_APPLIES: dict[Code, Callable[[Situation], bool]] = {
    Code.BROKER: lambda s: s.problem != "",
    Code.SILENT: lambda s: s.online is False,
    Code.UNSEEN: lambda s: s.online is not True,
    Code.STOPPED: lambda s: s.latched,
    Code.STOPPING: lambda s: s.stopping,
    Code.RESET: lambda s: s.free_s < RESET_S,
    Code.UNKNOWN: lambda s: not s.published,
    Code.NO_DRIVE: lambda s: not s.drives,
    Code.LEASE: lambda s: s.driven,
    Code.LISTENING: lambda s: s.listening,
    Code.SCRIPT: lambda s: s.script and not s.arbitrates,
    Code.LATE: lambda s: s.late_s >= LATE_S,
}


def first_reason(situation: Situation, order: Sequence[Code] = ORDER) -> Code | None:
    """The reason that counts; None: nothing speaks against driving."""
    return next((code for code in order if _APPLIES[code](situation)), None)


_WORDS = {
    Code.SILENT: "{name} is silent",
    Code.UNSEEN: "{name} has not been seen yet",
    Code.STOPPED: "Stopped by {by}",
    Code.STOPPING: "Emergency stop",
    Code.RESET: "It was just reset: wait a moment",
    Code.UNKNOWN: "{name} has not published what it can do",
    Code.NO_DRIVE: "This component does not drive",
    Code.LEASE: "{driven} is driving",
    Code.LISTENING: "Take control to drive",
    Code.SCRIPT: "A script is driving: stop it first",
}


def words(code: Code | None, name: str, *, stopped: EstopState | None = None, driven: str = "") -> str:
    """Return a reason for people; "" for none, and for those that only one program has. ``driven``: by whom."""
    by = stopped.by if stopped is not None and stopped.by else "unknown"
    return _WORDS.get(code, "").format(name=name, by=by, driven=driven) if code is not None else ""
