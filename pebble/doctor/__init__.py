"""Checks whether a machine is ready for a robot; each problem that is found comes with the command that fixes it."""

from dataclasses import dataclass
from enum import Enum
from functools import partial


class Level(Enum):
    OK = "ok"
    WARN = "warn"
    FAIL = "fail"
    SKIP = "skip"  # not tried; its text completes "because"


@dataclass(frozen=True, slots=True)
class Finding:
    """The result of one check: its subject, its state, and the command or config change that fixes it."""

    level: Level
    what: str
    text: str
    fix: str = ""


ok, warn, fail, skip = (partial(Finding, level) for level in Level)
