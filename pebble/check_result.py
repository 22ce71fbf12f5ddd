"""Results of checks of a machine, a broker or a robot; extensions declare checks of theirs for ``pebble doctor``."""

from dataclasses import dataclass
from enum import StrEnum
from functools import partial


class State(StrEnum):
    OK = "ok"
    WARN = "warn"
    FAILED = "failed"
    SKIPPED = "skipped"


@dataclass(frozen=True, slots=True)
class CheckResult:
    """The result of one check.

    ``fix`` is the command or config change that ends a failure; ``what`` is the subject, where a check has several.
    The text of a check that was skipped completes "skipped because", and its fix is what would let it be made.
    """

    state: State
    text: str
    fix: str = ""
    what: str = ""


ok, warn, failed, skipped = (partial(CheckResult, state) for state in State)
