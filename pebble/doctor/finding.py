"""What the doctor has found out about one thing."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum


class Level(Enum):
    OK = "ok"
    WARN = "warn"
    FAIL = "fail"


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing looked at: what, how it is, and the command (or the change) that makes it right."""

    level: Level
    what: str
    text: str
    fix: str = ""
