"""Drives with the keys of a terminal, which repeats a held key and does not report that it is released. Pure.

A key counts as held for 0.4 s after each time it arrives. Motion belongs to a gesture, which lasts from the first key
until none is held. What interrupts a gesture ends it for good: keys that are still held move nothing before no key has
arrived for 0.4 s.
"""

from collections.abc import Sequence

from pebble.client.pace_of_link import WIDE
from pebble.client.terminal.key_decoder import DOWN, LEFT, RIGHT, UP
from pebble.contract.payloads import Drive

PERIOD_S = 0.05  # between two commands
HELD_S = 0.4  # after its last repetition
STALL_S = 0.25  # a process that stood still for longer does not go on as if nothing had happened
BURST = 8  # as many keys at once were held back on the way, and are old

_REPEATS_S = (0.05, 0.1)  # after a zero
_STEP_S = 0.02  # at least, between two commands
_NEVER = float("-inf")

#: Axis and direction of each key.
AXES = {
    "w": ("z", 1), UP: ("z", 1), "s": ("z", -1), DOWN: ("z", -1),
    "d": ("x", 1), RIGHT: ("x", 1), "a": ("x", -1), LEFT: ("x", -1),
    "q": ("y", 1), "e": ("y", -1),
}  # fmt: skip
ZERO, FINAL_ZERO = Drive(), Drive(valid_ms=0)  # after the second one an interrupted script does not resume


class KeyGesture:
    """``speed`` and ``turn`` are what a key moves with, 0..1. Times are seconds of one monotonic clock.

    Publish what :meth:`update`, :meth:`interrupt` and :meth:`stop` return. Call :meth:`update` every PERIOD_S and
    whenever keys were read.
    """

    def __init__(self, speed: float, turn: float) -> None:
        self.active = False
        self.must_release = False  # keys arrive that may not begin a gesture
        self.last = ZERO  # the newest command
        self._speed, self._turn = speed, turn
        self._held: dict[str, tuple[int, float]] = {}  # by axis: the direction, and when its key last arrived
        self._key_at = _NEVER  # when a key that moves anything last arrived, or a gesture was interrupted
        self._sent_at = self._updated_at = _NEVER
        self._burst = False
        self._repeats: list[float] = []

    def press(self, keys: Sequence[str], now: float) -> None:
        """The keys that were read; those that move nothing are ignored. The newest key of an axis counts."""
        moving = [AXES[key] for key in keys if key in AXES]
        for axis, direction in moving:
            self._held[axis] = direction, now
            self._key_at = now
        self._burst = self._burst or len(moving) >= BURST

    def update(self, allowed: bool, now: float, *, limit: float = 1.0, step_s: float = 0.0) -> list[Drive]:
        """What to publish now. ``allowed``: whether anything may be moved; ``limit`` reduces the speed.

        ``step_s``: at least, between two commands that move something.
        """
        stalled, self._updated_at = now - self._updated_at > STALL_S, now
        if stalled or self._burst:
            self._burst = False
            self._repeats = []  # others may drive by now
            return self.interrupt(now)
        if self.must_release and now - self._key_at >= HELD_S:
            self.must_release = False
            self._held.clear()
        wanted = self._wanted(now, limit)
        if self.active and not allowed:
            return self.interrupt(now)
        if self.active and not wanted.moves:
            return self._end(ZERO, now)
        if wanted.moves and not self.must_release:
            if allowed:
                return self._step(wanted, now, step_s)
            self.must_release = True
        return self._repeat(now)

    def interrupt(self, now: float, *, repeat: bool = True) -> list[Drive]:
        """Something other than the driver ends the gesture. Nothing is published if there is none.

        ``repeat``: the zero is sent twice more; not if another driver may have begun.
        """
        self.must_release, self._key_at = True, now  # the pause is one in which keys were read
        self._held.clear()
        zero = self._end(FINAL_ZERO, now) if self.active else []
        if not repeat:
            self._repeats = []
        return zero

    def stop(self, now: float) -> list[Drive]:
        """A zero at once, whether anything is moving or not."""
        self.interrupt(now)
        return self._end(FINAL_ZERO, now)

    @property
    def due(self) -> float | None:
        """When :meth:`update` has something to do again, besides every PERIOD_S; None: not before a key."""
        return self._repeats[0] if self._repeats else None

    def _wanted(self, now: float, limit: float) -> Drive:
        self._held = {axis: held for axis, held in self._held.items() if now - held[1] < HELD_S}
        x, z, y = (self._held.get(axis, (0, 0.0))[0] for axis in "xzy")
        speed = min(self._speed, limit)
        return mixed(x * min(self._turn, limit), z * speed, y * speed)

    def _step(self, wanted: Drive, now: float, step_s: float) -> list[Drive]:
        changed = (wanted.x, wanted.z, wanted.y) != (self.last.x, self.last.z, self.last.y)
        if self.active and now - self._sent_at < max(step_s, _STEP_S if changed else PERIOD_S * 0.8):
            return []
        self.active, self._repeats = True, []
        self.last, self._sent_at = wanted, now
        return [wanted]

    def _end(self, zero: Drive, now: float) -> list[Drive]:
        self.active = False
        self.last, self._sent_at = zero, now
        self._repeats = [now + after for after in _REPEATS_S]
        return [zero]

    def _repeat(self, now: float) -> list[Drive]:
        if self.active or not self._repeats or now < self._repeats[0]:
            return []
        del self._repeats[0]
        return [self.last]


def mixed(x: float, z: float, y: float) -> Drive:
    """The command for these axes as the operator page makes it: no wheel is faster than 1."""
    left, right = z + x, z - x
    most = max(1.0, abs(left), abs(right))
    axes = ((left - right) / 2 / most, (left + right) / 2 / most, y)
    x, z, y = (round(axis, 3) + 0.0 for axis in axes)
    return Drive(x=x, z=z, y=y, valid_ms=WIDE.valid_ms)
