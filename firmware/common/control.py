"""Control of a board on Wi-Fi: requests, and when its state is published. A driver."""

import json
import os
from binascii import hexlify

from micropython import const

from common.lease import BY, DEVICE, USUAL_MS, Lease, shown
from common.payload import load
from common.ticks import diff

_PAUSE_MS = const(250)  # between two states


class Paced:
    """A state that is published when it has ``changed``, at most four times a second: when it is ``due``."""

    def __init__(self, now: int) -> None:
        self.changed = True  # since the last state
        self.due = False
        self._paused = False
        self._since = now

    def tick(self, now: int) -> None:
        if self._paused and diff(now, self._since) >= _PAUSE_MS:
            self._paused = False
        self.due = self.changed and not self._paused

    def published(self, now: int) -> None:
        self.changed = self.due = False
        self._paused = True
        self._since = now


class Control(Paced):
    """``request`` for its messages; the arbiter ticks the lease. Nothing is saved: at the start nobody has control."""

    def __init__(self, boot: str, now: int) -> None:
        Paced.__init__(self, now)
        self._boot = boot
        self.lease = Lease(now, diff, lambda: random_digits(4))

    def tick(self, now: int) -> None:
        lease = self.lease
        self.changed = self.changed or lease.changed
        lease.changed = False
        Paced.tick(self, now)

    def request(self, raw: memoryview, over: bool, now: int) -> None:
        """Requests and releases; ``over``: without asking. What cannot be parsed is none."""
        try:
            body = load(raw)
        except (ValueError, OverflowError, MemoryError):
            return
        if isinstance(body, dict):
            inner = body.get("value")
            request = request_of(inner if isinstance(inner, dict) else body)
            if request:
                who, for_ms = request
                if for_ms:
                    self.lease.hold(who, for_ms, over, now)
                else:
                    self.lease.release(who, now)

    def state(self) -> bytes:
        """The payload of outgoing/control/mcu, at most 300 bytes."""
        return compact(self.lease.state(self._boot)).encode()


def request_of(fields: dict) -> tuple[tuple, int] | None:
    """``(who, for_ms)``, 0: a release; None: it is no request."""
    name = fields.get("id")
    by = fields.get("by", "")
    device = fields.get("device", "")
    want = fields.get("want", "hold")
    for_ms = fields.get("for_ms", USUAL_MS)
    for text in (name, by, device):
        if not isinstance(text, str):
            return None
    if len(name) != 8 or type(for_ms) not in (int, float) or want not in ("hold", "release"):
        return None
    for digit in name:
        if digit not in "0123456789abcdefABCDEF":
            return None
    return (shown(by, BY), name, shown(device, DEVICE)), 0 if want == "release" else int(min(max(for_ms, 1), 60_000))


def random_digits(count: int) -> str:
    """Twice as many hex digits."""
    return hexlify(os.urandom(count)).decode()


def compact(fields: dict) -> str:
    return json.dumps(fields, separators=(",", ":"))
