"""Decides by the states of motor owners whether a script may start, and why a running one must end. Pure."""

from collections.abc import Collection, Iterator

from pebble.contract.payloads import LAST_RUN, ControlState, EstopState
from pebble.extensions.scripts.runs import SUPERSEDED, newest
from pebble.motion.arbiter import newer

_MOST = 16  # owners; their names come from other processes

#: By owner, its boot, its count of stops, and what it had barred.
Baseline = dict[str, tuple[str, int, int]]

OVERRIDDEN = "stopped by an operator"


class MotorOwners:
    """The newest state of each motor owner; if ``names`` are given, only of owners with these names."""

    def __init__(self, names: Collection[str]) -> None:
        self.newest_run = 0  # of all that were received or used; an owner bars the run before it
        self._names = names
        self._states: dict[str, EstopState] = {}
        self._controls: dict[str, ControlState] = {}

    def receive(self, owner: str, state: EstopState) -> None:
        if self._takes(owner, self._states):
            self._states[owner] = state

    def receive_control(self, owner: str, state: ControlState) -> None:
        if self._takes(owner, self._controls):
            self._controls[owner] = state

    def _takes(self, owner: str, owners: Collection[str]) -> bool:
        return owner in self._names or (not self._names and (owner in owners or len(owners) < _MOST))

    def holder_beside(self, by: str) -> str:
        """Return who has control at the first owner by name; empty if none has, or if the account of ``by`` has it."""
        state = self._controls[min(self._controls)] if self._controls else None
        if state is None or not state.key or state.by.partition("/")[0] == by.partition("/")[0]:
            return ""
        return state.by or "a program of the robot"

    def note_run(self, run: int) -> None:
        """Note the run number ``run`` of a drive command."""
        if newer(run, self.newest_run):
            self.newest_run = run

    @property
    def barred(self) -> int:
        """Newest run that can no longer move anything."""
        return newest(state.last_barred for state in self._states.values())

    def steps_to(self, run: int) -> Iterator[int]:
        """Yield run numbers: after a zero with each of them, every owner takes ``run`` for newer than what it bars.

        Needed if a stranger sent numbers far ahead while an owner was away. If ``run`` is more than half of all numbers
        ahead of that owner's, it seems older, as numbers begin again after LAST_RUN. A number half-way there does not.
        """
        for barred in [state.last_barred for state in self._states.values()]:
            if not newer(run, barred):
                ahead = (run - barred) & LAST_RUN
                half_way = (barred + ahead // 2) & LAST_RUN  # newer than ``barred``, and ``run`` is newer than it
                yield half_way or LAST_RUN  # 0 is no run

    @property
    def refusal(self) -> str:
        """Reason why no script may start; empty if one may."""
        return next((_stopped(owner, state) for owner, state in self._states.items() if state.latched), "")

    def baseline(self) -> Baseline:
        """Return each owner's boot, count of stops and last barred run, to compare with later states."""
        return {owner: (state.boot, state.count, state.last_barred) for owner, state in self._states.items()}

    @property
    def held(self) -> bool:
        """True if a person has control of any owner."""
        return any(state.key for state in self._controls.values())

    def ending(self, run: int, baseline: Baseline, signs: bool = True) -> str:
        """Return why this run must end; empty if it may continue. New owners are added to ``baseline``.

        ``signs`` False: its script does not sign its commands. Owners take them for a person's, and bar the run at
        once: here a barred run is no reason to end.
        """
        for owner, state in self._states.items():
            boot, count, barred = baseline.setdefault(owner, (state.boot, state.count, 0))
            if state.latched or (state.boot == boot and state.count != count):
                return _stopped(owner, state)
            # An owner bars all runs up to a number. When a run begins, that becomes the number before it; when a person
            # drives, it becomes the newest run. ``barred`` is the owner's number from before this run began.
            is_barred = state.last_barred != barred and not newer(run, state.last_barred)
            if signs and is_barred:
                # A barred number other than this run's is a newer run, which has begun; or a command of one has come.
                newer_began = state.last_barred != run or newer(self.newest_run, run)
                return SUPERSEDED if newer_began else OVERRIDDEN
            if state.boot != boot:
                return f"motor owner {owner} was restarted: start the script again"
        return ""


def _stopped(owner: str, state: EstopState) -> str:
    by = "".join(letter if letter.isprintable() else "?" for letter in state.by[:32])
    reset = "reset it first" if state.latched else "it was reset since"
    return f"emergency stop{f' by {by}' if by else ''} of motor owner {owner}: {reset}"
