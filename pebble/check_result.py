"""The result of one check, of a machine, of a robot that runs, or of a robot by the contract."""

from dataclasses import dataclass
from enum import StrEnum


class State(StrEnum):
    OK = "ok"
    WARN = "warn"
    FAILED = "failed"
    SKIPPED = "skipped"


@dataclass(frozen=True, slots=True)
class CheckResult:
    """``what``: its subject, where one check has several; ``fix``: the command or config change that ends a failure.

    The text of a check that was skipped completes "skipped because", and its fix is what would let it be made.
    """

    state: State
    what: str
    text: str
    fix: str = ""
