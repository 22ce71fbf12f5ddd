"""The drive commands of a script: which are published, and when. Pure: the caller receives, waits and has a clock.

The wheels belong to the motor owner, whose arbiter decides. This part only knows the messages of owners and other
senders. It tells a script that its commands have no effect, and keeps it from disturbing others.
"""

from collections.abc import Callable, Mapping

from msgspec.structs import replace

from pebble.contract.payloads import SCRIPT, Drive, EstopState
from pebble.extensions.scripts.runs import SUPERSEDED
from pebble.motion.arbiter import HOLD_MS, newer

MAX_PER_S = 50  # drive commands of a script; the newest takes its turn, a zero goes at once
HOLD_S = HOLD_MS / 1000  # so long after a person's last command scripts are refused
_SLOT_S = 0.021  # between commands: with an early zero and the final one, at most MAX_PER_S in any second
_MAX_OWNERS = 64  # whose last state is remembered
_GRACE_S = 0.1  # for the first command of a newer run to arrive: it bars this run as a person does

ENDED = "this run was ended"  # by others: why, is known a moment later

_ZERO = Drive()


class DriveSender:
    """The drive commands of one run of a script.

    ``publish`` sends one command and returns whether it was accepted. Times are seconds of one monotonic clock. Call
    :meth:`tick` at :attr:`due`. One thread at a time.

    At most MAX_PER_S commands a second are published; only the newest command waits for its turn. A zero is published
    at once, in place of the command that waits; only repetitions of a published zero take their turn.
    """

    def __init__(self, run: int, publish: Callable[[Drive], bool]) -> None:
        self.run = run
        self._publish = publish
        self._tried = False  # the script has commanded anything: scripts that never do are not ended
        self._pending: Drive | None = None  # the command that waits for its turn
        self._turn = float("-inf")  # when the next command may be published
        self._zero_is_last = False  # the newest accepted command is a zero
        self._person_at = float("-inf")  # when a person last commanded
        self._latched: EstopState | None = None  # of the owner that was stopped last
        self._owners: dict[str, EstopState] = {}  # the newest state of each
        self._barred_at: float | None = None  # when an owner first said that it refuses this run for good
        self._superseded = False  # by a newer run
        self._end = ""  # why this run can never drive again
        self._final = False  # the final zero was published

    # -- what the script wants

    def drive(self, wanted: Drive, now: float) -> bool:
        """Publish a command now or at its turn; return False if it has no effect, as far as is known."""
        self._tried = True
        if self._end:
            return False
        signed = replace(wanted, source=SCRIPT, run=self.run)
        obeyed = not self.refusal(now)
        self._pending = None
        if signed.moves and not obeyed:
            return False
        is_first_zero = not signed.moves and not self._zero_is_last
        if is_first_zero or now >= self._turn:
            return self._send(signed, now) and obeyed
        self._pending = signed
        return obeyed

    def drive_another(self, now: float) -> str:
        """Note that the script drives another robot, too; return :meth:`refusal`, which holds there as well."""
        self._tried = True
        return self.refusal(now)

    def end(self, why: str, now: float) -> None:
        """Publish a final zero, if the script has ever sent a command, and nothing after it."""
        if self._final:
            return
        self._end, self._final = self._end or why, True
        self._pending = None
        if self._tried:
            self._send(replace(_ZERO, source=SCRIPT, run=self.run), now)

    def tick(self, now: float) -> None:
        """Publish the command that waits for its turn; drop it if it moves the robot and there is a :meth:`refusal`."""
        if self._pending is None or now < self._turn:
            return
        pending, self._pending = self._pending, None
        if not (pending.moves and self.refusal(now)):
            self._send(pending, now)

    # -- what others have published

    def receive(self, drive: Drive, now: float) -> None:
        """Handle a drive command of another sender, which arrives now."""
        if not drive.signed:
            self._person_at = now
        elif isinstance(drive.run, int) and newer(drive.run, self.run):
            self._superseded = True

    def owners(self, states: Mapping[str, EstopState], now: float) -> None:
        """Handle the newest states of all motor owners."""
        if self._tried:
            for owner, state in states.items():
                self._compare(owner, self._owners.get(owner), state)
        remembered = self._owners if len(self._owners) < _MAX_OWNERS else {}
        self._owners = {**remembered, **states}  # an owner that is gone for a while may come back restarted
        latched = [state for state in states.values() if state.latched]
        self._latched = max(latched, key=lambda state: state.since, default=None)
        # An owner bars all runs up to a number. This run is barred if that is its own number, or a newer one.
        barred = [state.last_barred for state in states.values() if not newer(self.run, state.last_barred)]
        if any(run != self.run for run in barred):  # a newer run is barred, too: so one has begun
            self._superseded = True
        elif barred and self._barred_at is None:  # by a person, unless a newer run shows itself soon: see `ended`
            self._barred_at = now

    # -- what follows

    def overridden(self, now: float) -> bool:
        """True if a person has commanded within the last 2 s."""
        return now - self._person_at < HOLD_S

    def refusal(self, now: float) -> str:
        """Return why a command has no effect now, as far as is known; empty if it has one."""
        if self._end:
            return self._end
        if self._latched is not None:
            return f"the robot is stopped {_described(self._latched)}"
        if self._superseded or self._barred_at is not None:
            return ENDED
        return "a person drives" if self.overridden(now) else ""

    def ended(self, now: float) -> str:
        """Return why this run can never drive again; empty if it can, or if the script has never tried."""
        if not self._end and self._tried:
            if self._superseded:
                self._end = SUPERSEDED
            elif self._barred_at is not None and now >= self._barred_at + _GRACE_S:  # no newer run: a person barred it
                self._end = "stopped by an operator"
        return self._end

    @property
    def due(self) -> float | None:
        """Time to call :meth:`tick`, and to check :meth:`ended`; None: only after another event."""
        times = [] if self._pending is None else [self._turn]
        if self._barred_at is not None and not self._end:
            times.append(self._barred_at + _GRACE_S)
        return min(times, default=None)

    def _compare(self, owner: str, before: EstopState | None, now: EstopState) -> None:
        """End this run if an owner's states show an emergency stop, or a restart: the owner may forget barred runs."""
        if self._end or before is None:
            return
        if before.boot != now.boot:
            self._end = f"{owner}, which moves the wheels, has restarted"
        elif before.count != now.count or (now.latched and not before.latched):
            self._end = f"emergency stop {_described(now)}"
        elif before.latched and not now.latched:
            self._end = "the emergency stop was reset: start the script again"

    def _send(self, command: Drive, now: float) -> bool:
        self._turn = max(self._turn, now) + _SLOT_S
        accepted = self._publish(command)
        self._zero_is_last = accepted and not command.moves
        return accepted


def _described(state: EstopState) -> str:
    by = f"by {state.by}" if state.by else "by an unknown person"
    return f"{by} ({state.why})" if state.why else by
