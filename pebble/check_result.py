"""The results of checks of a machine, a broker or a robot; extensions declare checks for ``pebble doctor``."""

from dataclasses import dataclass
from enum import StrEnum
from functools import partial


class State(StrEnum):
    """The outcome of a check."""

    OK = "ok"
    WARN = "warn"
    FAILED = "failed"
    SKIPPED = "skipped"


@dataclass(frozen=True, slots=True)
class CheckResult:
    """The result of one check.

    ``fix`` is the command or config change that ends a failure; ``what`` is the subject, if a check has several.
    The text of a skipped check completes "skipped because", and its fix makes the check possible.
    """

    state: State
    text: str
    fix: str = ""
    what: str = ""


ok, warn, failed, skipped = (partial(CheckResult, state) for state in State)  # in its order
