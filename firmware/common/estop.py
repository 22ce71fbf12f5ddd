"""The emergency stop of a board on Wi-Fi: its messages, its state, and the file that survives a power cut. A driver."""

import json
import os

from micropython import const

from common.arbiter import Arbiter
from common.control import Control, Paced, compact, random_digits
from common.latch import Latch, reset_of, stop_of
from common.payload import load
from common.ticks import diff

_FILE = const("/estop.json")
_NEW = const("/estop.new")  # renamed when it is complete: a power cut leaves the old file or the new one
_NAMES = const(4)
_LONGEST_STATE = const(300)
_EROFS = const(30)  # not in every port's errno
_ENODEV = const(19)


class EmergencyStop(Paced):
    """``stop`` and ``reset`` for their messages, then ``save`` while the motors are off; ``tick`` every turn.

    Its state is never published in the turn of a stop.
    """

    def __init__(self, now: int, watchdog_ms: int) -> None:
        Paced.__init__(self, now)
        boot = random_digits(4)
        self.latch = Latch(boot, _NAMES, diff)
        self.control = Control(boot, now)
        self.arbiter = Arbiter(self.latch, self.control.lease, now, diff, watchdog_ms)
        self._barred = 0  # of the last state
        self._unsaved = False
        self._saves = True  # there is a file system that can be written to
        self._saved: bool | None = False  # `latched` by the file; None: unknown
        self._restore()

    def tick(self, now: int) -> None:
        self.arbiter.tick(now)
        if self.arbiter.barred != self._barred:
            self.changed = True
        Paced.tick(self, now)
        self.control.tick(now)

    # -- in

    def stop(self, raw: memoryview | None, since: int) -> bool:
        """Latch; False: this stop is known already. None, like what cannot be parsed, is a stop without a name."""
        name = by = why = ""
        if raw is not None:
            try:
                name, by, why = stop_of(load(raw))
            except (ValueError, OverflowError, MemoryError):
                pass
        self.changed = True
        new = self.arbiter.stop(name or random_digits(8), by, why, since)
        self._unsaved = self._unsaved or self.latch.latched  # again if writing failed
        return new

    def reset(self, raw: memoryview, now: int) -> None:
        """End the stop, if the sender saw its newest state."""
        try:
            order = reset_of(load(raw))
        except (ValueError, OverflowError, MemoryError):
            return
        self.changed = True
        if order and self.latch.reset(order[0], order[1], 0, now):
            self._unsaved = True

    # -- the state

    def state(self) -> bytes:
        """The payload of outgoing/estop/mcu, at most 300 bytes: the reason is cut."""
        state = self.latch.state(self._saved == self.latch.latched if self._saves else None)
        if self.arbiter.barred:
            state["barred"] = self.arbiter.barred
        text = compact(state)
        excess = len(text) - _LONGEST_STATE
        if excess > 0:
            state["why"] = state["why"][:-excess]
            text = compact(state)
        return text.encode()

    def published(self, now: int) -> None:
        Paced.published(self, now)
        self._barred = self.arbiter.barred

    # -- the file

    def save(self) -> None:
        """Write the file if `latched` has changed. This takes a while: the motors must be off."""
        if not self._unsaved:
            return
        self._unsaved = False
        latched = self.latch.latched
        if self._saved == latched:
            return
        self._saved = None
        try:
            with open(_NEW, "w") as file:
                json.dump(self.latch.saved(), file)
            os.rename(_NEW, _FILE)
            self._saved = latched
            self._saves = True
        except OSError as error:
            self._saves = error.errno not in (_EROFS, _ENODEV)

    def _restore(self) -> None:
        """No file: free. One that cannot be read: latched."""
        try:
            if _FILE[1:] not in os.listdir("/"):
                return
        except OSError:  # no file system
            self._saves = False
            return
        saved = None
        try:
            with open(_FILE) as file:
                saved = json.load(file)
        except (OSError, ValueError, MemoryError):
            pass
        self.latch.restore(saved)
        self._saved = self.latch.latched
