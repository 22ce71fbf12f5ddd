"""What the motor owners publish: whether a script may start, and why one that runs has to end. Pure."""

from __future__ import annotations

from collections.abc import Collection

from pebble.contract.payloads import EstopState
from pebble.runtime.runs import SUPERSEDED

_MOST = 16  # owners; their names come from other processes

#: By owner, its boot and its count of stops.
Baseline = dict[str, tuple[str, int]]

OVERRIDDEN = "stopped by an operator"


class MotorOwners:
    """The newest state of each motor owner; of those in ``names`` only, where there are any."""

    def __init__(self, names: Collection[str]) -> None:
        self.newest_run = 0  # of all drive commands; an owner bars the run before it
        self._names = names
        self._states: dict[str, EstopState] = {}

    def receive(self, owner: str, state: EstopState) -> None:
        if owner in self._names or (not self._names and (owner in self._states or len(self._states) < _MOST)):
            self._states[owner] = state

    @property
    def barred(self) -> int:
        """No run up to this one moves anything."""
        return max((state.last_barred for state in self._states.values()), default=0)

    @property
    def refusal(self) -> str:
        """Why no script may start; empty if one may."""
        return next((_stopped(owner, state) for owner, state in self._states.items() if state.latched), "")

    def baseline(self) -> Baseline:
        """What must not change while a script runs."""
        return {owner: (state.boot, state.count) for owner, state in self._states.items()}

    def ending(self, run: int, baseline: Baseline) -> str:
        """Why this run has to end; empty if it may go on. Owners that are new are added to ``baseline``."""
        for owner, state in self._states.items():
            boot, count = baseline.setdefault(owner, (state.boot, state.count))
            if state.latched or (state.boot == boot and state.count != count):
                return _stopped(owner, state)
            if state.last_barred >= run:
                return SUPERSEDED if max(state.last_barred, self.newest_run) > run else OVERRIDDEN
            if state.boot != boot:
                return f"motor owner {owner} was restarted: start the script again"
        return ""


def _stopped(owner: str, state: EstopState) -> str:
    by = "".join(letter if letter.isprintable() else "?" for letter in state.by[:32])
    reset = "reset it first" if state.latched else "it was reset since"
    return f"emergency stop{f' by {by}' if by else ''} of motor owner {owner}: {reset}"
