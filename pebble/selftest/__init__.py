"""Tests a robot that runs, end to end; and packs what others need to repair or to restore it."""

from dataclasses import dataclass
from enum import StrEnum


class State(StrEnum):
    OK = "ok"
    FAILED = "failed"
    SKIPPED = "skipped"


@dataclass(frozen=True, slots=True)
class Outcome:
    """What one check found; ``fix`` is the command or change that ends a failure."""

    state: State
    text: str
    fix: str = ""


def ok(text: str) -> Outcome:
    return Outcome(State.OK, text)


def failed(text: str, fix: str) -> Outcome:
    return Outcome(State.FAILED, text, fix)


def skipped(why: str, fix: str = "") -> Outcome:
    """``why`` completes "skipped because"; ``fix``: what would let the check be made."""
    return Outcome(State.SKIPPED, why, fix)
