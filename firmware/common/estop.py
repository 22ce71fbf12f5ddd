"""Emergency stop and control of a board on Wi-Fi: messages, states, and a file that survives a power cut. A driver."""

import json
import os
from binascii import hexlify

from micropython import const

from common.arbiter import Arbiter
from common.latch import Latch, fields, reset_of, stop_of
from common.lease import Lease, request_of
from common.payload import load
from common.ticks import diff

_FILE = const("/estop.json")
_NEW = const("/estop.new")  # renamed when it is complete: a power cut leaves the old file or the new one
_NAMES = const(4)
_LONGEST_STATE = const(300)
_PAUSE_MS = const(250)  # between two states
_EROFS = const(30)  # not in every port's errno
_ENODEV = const(19)
_ESTOP = const(b"estop/mcu")
_CONTROL = const(b"control/mcu")
_HOLDER = const(
    '{"by":"%s","id":"%s","key":"%s","device":"%s","asks":"%s","asks_id":"%s","others":%s,"named":%s,"boot":"%s"}'
)


class EmergencyStop:
    """Stop and control. Pass messages to ``stop``, ``reset``, ``request``; ``tick`` each turn, ``save`` at rest."""

    def __init__(self, now: int, watchdog_ms: int, strangers: int, names) -> None:
        """Store the arguments; ``strangers``: see `Lease`. ``names``: names.py; None: accounts of senders are ""."""
        self.latch = Latch(_random(4), _NAMES, diff)
        self.lease = Lease(now, diff, _random, strangers)
        self.arbiter = Arbiter(self.latch, self.lease, now, diff, watchdog_ms)
        self.changed = True  # since the last state
        self.due = b""  # the topic of the state to publish now, that of the stop first; at most four states a second
        self.names = names
        self.stoppable = self.controllable = True  # the broker granted the topics of stops, and of control
        self._barred = 0  # `arbiter.barred` at the last state
        self._paused = False  # a state was published less than _PAUSE_MS ago
        self._since = now  # when the last state was published
        self._unsaved = False  # there was a stop or a reset since the last `save`
        self._saves = True  # there is a file system that can be written to
        self._saved: bool | None = False  # whether the file says `latched`; None: unknown
        self._restore()

    def tick(self, now: int) -> None:
        self.arbiter.tick(now)
        if self._paused and diff(now, self._since) >= _PAUSE_MS:
            self._paused = False
        if self.arbiter.barred != self._barred:
            self.changed = True
        self.due = b""
        if not self._paused:
            if self.changed and self.stoppable:
                self.due = _ESTOP
            elif self.lease.changed and self.controllable:
                self.due = _CONTROL

    # -- in

    def stop(self, raw: memoryview | None, by: str, since: int) -> bool:
        """Latch; return False if this stop is known. A ``raw`` that cannot be parsed, or None, is one without a name.

        ``by``: the account of the sender; "": there is none, and the name in the message is not checked. ``since``: the
        time of day, as `Clock.read` returns it.
        """
        name = why = ""
        sender = by
        if raw is not None:
            try:
                name, sender, why = stop_of(self._load(raw, by))
                if self.names and not by:
                    sender = self.names.claimed(sender)
            except (ValueError, OverflowError, MemoryError):
                pass
        self.changed = True
        new = self.arbiter.stop(name or _random(8), sender, why, since)
        self._unsaved = self._unsaved or self.latch.latched  # a known stop, too: writing it may have failed
        return new

    def _load(self, raw: memoryview, by: str):
        """Return a parsed command; if there is an account, it becomes the sender."""
        body = load(raw)
        if by:
            self.names.sign(body, by)
        return body

    def reset(self, raw: memoryview, now: int) -> None:
        """End the stop, if the sender has seen its newest state."""
        try:
            order = reset_of(load(raw))
        except (ValueError, OverflowError, MemoryError):
            return
        self.changed = True  # also if it is refused: the state says why
        if order and self.latch.reset(order[0], order[1], 0, now):  # boot, count, and no age: it was read just now
            self._unsaved = True

    # -- the state

    def request(self, raw: memoryview, by: str, urgent: bool, now: int) -> None:
        """Handle a request for control, or its end. ``by``: the account; ``urgent``: take control without asking."""
        try:
            order = request_of(fields(self._load(raw, by)))
        except (ValueError, OverflowError, MemoryError):
            return
        if order:
            name, person, device, ms = order
            if ms:  # 0: a release
                self.lease.hold((by, name, person, device), ms, urgent, now)
            else:
                self.lease.release((by, name), now)

    def state(self) -> bytes:
        """Return the payload of the state that is ``due``, at most 300 bytes: the reason of a stop is cut."""
        if self.due == _CONTROL:
            lease = self.lease
            _, name, by, device = lease.holder or ("", "", "", "")
            _, asks_id, asks, _ = lease.asker or ("", "", "", "")
            others, named = json.dumps(lease.others), json.dumps(self.names is not None)
            return (_HOLDER % (by, name, lease.key, device, asks, asks_id, others, named, self.latch.boot)).encode()
        state = self.latch.state(self._saved == self.latch.latched if self._saves else None)  # as `persisted`
        if self.arbiter.barred:
            state["barred"] = self.arbiter.barred
        text = _json(state)
        excess = len(text) - _LONGEST_STATE
        if excess > 0:
            state["why"] = state["why"][:-excess]
            text = _json(state)
        return text.encode()

    def published(self, now: int) -> None:
        """Note that the state which was ``due`` is published. Only the state of the stop has the barred runs."""
        if self.due == _CONTROL:
            self.lease.changed = False
        else:
            self.changed = False
            self._barred = self.arbiter.barred
        self.due = b""
        self._paused = True
        self._since = now

    # -- the file

    def save(self) -> None:
        """Write the file if `latched` has changed. This takes a while: the motors must be off."""
        if not self._unsaved:
            return
        self._unsaved = False
        latched = self.latch.latched
        if self._saved == latched:
            return
        self._saved = None  # until the file is complete
        try:
            with open(_NEW, "w") as file:
                json.dump(self.latch.saved(), file)
            os.rename(_NEW, _FILE)
            self._saved = latched
            self._saves = True
        except OSError as error:
            self._saves = error.errno not in (_EROFS, _ENODEV)  # other errors may pass: the next stop tries again

    def _restore(self) -> None:
        """Restore the latch: free without a file, latched if it cannot be read."""
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


def _random(count: int) -> str:
    return hexlify(os.urandom(count)).decode()


def _json(fields: dict) -> str:
    return json.dumps(fields, separators=(",", ":"))
