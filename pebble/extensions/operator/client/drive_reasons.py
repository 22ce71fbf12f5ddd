"""The reasons why a robot cannot be driven: their order, their sentences, and their limits. Pure.

The page's additional reasons are in ``static/core/reasons.js``; both run ``tests/vectors/drive_reasons.json``. `make
docs` writes the table of sentences.
"""

from collections import defaultdict
from collections.abc import Callable, Sequence
from enum import StrEnum
from typing import NamedTuple

from pebble.contract.payloads import EstopState

SILENT_S = 1.5  # a robot is not called silent before
RESET_S = 0.6  # after a reset, robots refuse commands until they have paused for 0.5 s
LATE_S = 0.6  # of a round trip, or of a command: one that takes longer is not sent, or moves nothing
SLOW_S, SLOW_SPEED = 0.3, 0.4  # from this round trip on, the speed is limited


class Code(StrEnum):
    """A reason. Reasons that only a page has, such as being in the background, are not among them."""

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
    """The facts about a robot and the connection to it at one moment."""

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


#: The order in which a terminal looks for a reason, and a page for those that it shares with this table.
ORDER = tuple(Code)
#: The reasons for which the page's server refuses a drive command of a page.
SERVER_ORDER = (Code.BROKER, Code.NO_DRIVE, Code.STOPPED, Code.STOPPING, Code.RESET, Code.SILENT)
#: The reasons for which it refuses to start a script; LEASE only where the robot does not arbitrate.
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
    """Return the first reason that applies; None if the robot can be driven."""
    return next((code for code in order if _APPLIES[code](situation)), None)


#: What people are told: on the page, which gets the table from its server, in a terminal, and by the server.
WORDS = {
    "broker": "The server cannot reach the broker: {problem}",
    "failed": "This page does not work ({part}): load it again",
    "reload": "This page is older than the server: load it again",
    "plain": "Driving needs https: this connection is not encrypted",
    "role": "Log in as driver to drive",
    "hidden": "This page is in the background",
    "silent": "{name} is silent{since}",
    "unseen": "{name} has not been seen yet",
    "stopped": "Stopped by {by}",
    "stopping": "Emergency stop",
    "reset": "It was just reset: wait a moment",
    "unknown": "{name} has not published what it can do",
    "no-drive": "{name} does not drive",
    "free": "Take control to drive",
    "listening": "Take control to drive",
    "idle": "{who} has control, but does not drive",
    "lease": "{who} is driving",
    "kept": "{who} has control",
    "asked": "{who} is asked for control",
    "loading": "This screen is still loading",
    "dialog": "Close the panel first",
    "script": "{script} is driving: stop it first",
    "itself": "{name} drives itself: {script}",
    "picture": "The picture is {age} s old",
    "picture-none": "There is no picture yet",
    "picture-waits": "Pictures wait while you drive",
    "picture-unknown": "How old this stream is, is not known",
    "late": "Commands are late{by_ms}",
    "pad": "The gamepad stands still: move its stick to neutral and back",
    "focus": "Click this page first: keys go to another window",
    "release": "Let go first",
}


def words(
    code: str | None,
    name: str = "",
    *,
    stopped: EstopState | None = None,
    driven: str = "",
    problem: str = "",
    script: str = "",
) -> str:
    """Return the sentence for people about a state; "" if it has none. ``driven``: the driver's name."""
    by = stopped.by if stopped is not None and stopped.by else "unknown"
    values = {"name": name, "by": person(by), "who": person(driven), "script": script or "A script", "problem": problem}
    return WORDS.get(code or "", "").format_map(defaultdict(str, values))  # "": what only pages fill in


def person(by: str, *, login: bool = True) -> str:
    """Return the sender ``by`` in words for people.

    A server without logins calls its user ``local``, and may add the device. ``login`` False: this server has none.
    """
    if by.partition(" ")[0] != "local":
        return by
    return "somebody without a login" if login else "somebody at this computer"
