"""What the wheels were commanded to do, by the rules of the motor owner, for a sensor that cannot see the direction."""

import operator

from pebble.contract.payloads import ControlState, Drive, EstopState
from pebble.motion.arbiter import PERSON, REFUSED, UNKNOWN_RUN, Arbiter
from pebble.motion.latch import Latch
from pebble.motion.lease import Lease

_HOLD_S = 0.35  # wheels coast so long
_LEAST_POWER = 0.02
_LONG_AGO_MS = 10_000  # the motor owner started before us: what it refuses in its first seconds does not apply


class MotorPower:
    """The power of both motors, from the commands that the motor owner obeys.

    ``watchdog_s`` is its own, and ``strangers`` what it does with commands without a key.
    """

    def __init__(self, watchdog_s: float, strangers: str, now: float) -> None:
        self._latch = Latch("", 1, operator.sub)
        rule = ("drive", "free", "refuse").index(strangers)
        self._lease = Lease(0, lambda _later, _earlier: -1, str, rule)  # only its owner ends it
        began, watchdog_ms = _ms(now) - _LONG_AGO_MS, round(1000 * watchdog_s)
        self._arbiter = Arbiter(self._latch, self._lease, began, operator.sub, watchdog_ms)
        self._power = (0.0, 0.0)  # left, right, until _until
        self._until = now
        self._signs = [0, 0]
        self._signs_until = [now, now]

    def command(self, drive: Drive, now: float) -> bool:
        """Take a drive command; False: it is refused, and changes nothing."""
        valid_ms = drive.valid_ms if isinstance(drive.valid_ms, int) else -1
        limit = self._arbiter.judge(drive.moves, _run(drive), valid_ms, _ms(now), drive.key or "")
        if limit == REFUSED:
            return False
        self.at(now)
        self._power = (_clamp(drive.z + drive.x), _clamp(drive.z - drive.x)) if limit else (0.0, 0.0)
        self._until = now + limit / 1000
        return True

    def owner(self, state: EstopState) -> None:
        """Follow the motor owner's state."""
        self._latch.latched = state.latched
        self._arbiter.bar(state.last_barred)
        if state.latched:
            self._power = (0.0, 0.0)

    def control(self, state: ControlState) -> None:
        """Follow who has control: a change of it halts the wheels."""
        if state.key != self._lease.key:
            self._lease.key = state.key
            self._lease.holder = ("",)  # of any account: the key shows it
            self._power = (0.0, 0.0)

    def at(self, now: float) -> tuple[tuple[float, int], tuple[float, int]]:
        """Power and possible direction of the left and the right wheel; a direction remains while wheels coast."""
        if now >= self._until:
            self._note_signs(self._until)
            self._power = (0.0, 0.0)
        else:
            self._note_signs(now)
        directions = [s if now <= until else 0 for s, until in zip(self._signs, self._signs_until, strict=True)]
        return (self._power[0], directions[0]), (self._power[1], directions[1])

    def _note_signs(self, now: float) -> None:
        for wheel, power in enumerate(self._power):
            if abs(power) >= _LEAST_POWER:
                self._signs[wheel] = 1 if power > 0.0 else -1
                self._signs_until[wheel] = now + _HOLD_S


def _run(drive: Drive) -> int:
    if not drive.signed:
        return PERSON
    return drive.run if isinstance(drive.run, int) else UNKNOWN_RUN


def _clamp(power: float) -> float:
    return max(-1.0, min(1.0, power))


def _ms(seconds: float) -> int:
    return round(1000 * seconds)
