"""Ages of messages when they arrive, by the clocks of their senders (T19).

A sender's clock may show any time. The fastest recent message of a sender is assumed to have needed no time on its way:
a message that seems to have needed longer has waited somewhere.
"""

import threading
from collections.abc import Hashable
from math import inf
from typing import Final, Generic, TypeVar

from msgspec import Struct

_DRIFT: Final = 1e-3  # two clocks drift apart by less, seconds per second
_YOUNG_S: Final = 2.0  # so long a clock is not trusted alone: all its messages may have waited in one queue
_JUMP_S: Final = 1.0  # a message that is so much faster than all before shows that a clock was set, or a queue ended
_IDLE_S: Final = 60.0  # a clock that was not heard for so long gives way to another
_CLOCKS: Final = 256  # of machines, one for each topic on which they send

K = TypeVar("K", bound=Hashable)


class Patience(Struct, frozen=True):
    """Times in seconds after which a sender is believed whose messages all seem late: its clock was changed.

    ``set_back_s`` counts if the sender's stamps went back, which no delay explains, else ``believed_s``. A pause longer
    than ``gap_s`` begins the time anew. A sender that was silent for ``silent_s`` is forgotten.
    """

    believed_s: float
    set_back_s: float
    gap_s: float = inf
    silent_s: float = inf


class _Clock:
    """The clock of one sender. A *difference* is our time when a message arrives, minus its stamp."""

    __slots__ = ("began", "least", "newest", "other", "patience_s", "proved", "received_at")

    def __init__(self, sent: float, now: float, patience_s: float = inf) -> None:
        self.began = self.received_at = now
        self.newest = sent  # the newest stamp
        self.least = now - sent  # the difference of the fastest message
        self.proved = -inf  # without any delay the difference is at least this, by messages that came in time
        self.patience_s = patience_s
        self.other: _Clock | None = None  # the clock if it was changed, and the messages since then were not late

    def receive(self, sent: float, now: float) -> None:
        drift = _DRIFT * (now - self.received_at)
        self.least = min(now - sent, self.least + drift)
        self.proved += drift
        self.received_at, self.newest = now, max(self.newest, sent)

    @property
    def standing(self) -> tuple[float, float]:
        """Sort key for forgetting: the shortest time from first to newest message; if equal, the longest silence."""
        return self.received_at - self.began, self.received_at


class SenderClocks(Generic[K]):
    """The clocks of at most ``most`` senders, each identified by a key.

    If there is no room, a silent sender is forgotten; if none is silent, the sender with the shortest time between its
    first and its newest message: a flood of invented keys does not displace a sender that continues.
    """

    def __init__(self, most: int, patience: Patience) -> None:
        self._most, self._patience = most, patience
        self._lock = threading.Lock()
        self.clocks: dict[K, _Clock] = {}

    def age_s(self, key: K, sent: float, waited_s: float, now: float, late_s: float) -> float:
        """Return the seconds that a message stamped ``sent`` has waited at ``now``; learn the sender's clock from it.

        ``waited_s``: the most that it can have waited, by other evidence. If that is at most ``late_s``, the message
        proves a difference of the clocks. Until a clock is known for 2 s (_YOUNG_S), the age is at least ``waited_s``.
        """
        with self._lock:
            clock = self.clocks.get(key)
            if clock is None or now - clock.received_at > self._patience.silent_s or now - sent < clock.least - _JUMP_S:
                self._make_room(key, now)
                clock = self.clocks[key] = _Clock(sent, now)
            else:
                clock.receive(sent, now)
                clock = self._clock_to_use(key, clock, sent, now, late_s)
            if waited_s <= late_s:
                clock.proved = max(clock.proved, now - sent - waited_s)
            # Without delay the difference is at least `proved`, at most `least`. The smaller errs towards a longer age.
            age = now - sent - min(clock.least, clock.proved)
            return age if now - clock.began >= _YOUNG_S else max(age, waited_s)

    def is_passed(self, key: K, sent: float) -> bool:
        """True if the newest stamp is later than ``sent`` by less than a second. If by more, the clock was set back."""
        with self._lock:
            clock = self.clocks.get(key)
            return clock is not None and clock.newest - _JUMP_S < sent < clock.newest

    def pass_over(self, key: K, sent: float, now: float) -> None:
        """Note the stamp of a message that is not judged, so that :meth:`is_passed` recognises older ones."""
        with self._lock:
            clock = self.clocks.get(key)
            if clock is not None and sent - clock.newest < now - clock.received_at + _JUMP_S:
                clock.newest = max(clock.newest, sent)

    def _make_room(self, key: K, now: float) -> None:
        """Forget a clock if there is no room for another sender."""
        clocks = self.clocks
        if key not in clocks and len(clocks) >= self._most:
            replaced = min(clocks, key=lambda sender: clocks[sender].received_at)
            if now - clocks[replaced].received_at <= _IDLE_S:
                replaced = min(clocks, key=lambda sender: clocks[sender].standing)
            del clocks[replaced]

    def _clock_to_use(self, key: K, clock: _Clock, sent: float, now: float, late_s: float) -> _Clock:
        """Return the sender's clock, corrected if all its messages have seemed late for long enough."""
        if now - sent - clock.least <= late_s:
            clock.other = None  # on time: the sender's clock was not set
            return clock
        candidate, patience = clock.other, self._patience  # the candidate: the sender's clock, if it was set
        patience_s = patience.set_back_s if sent < clock.newest - _JUMP_S else patience.believed_s
        # A new candidate begins if there was none, after a pause, or once the stamps go back and so need less patience.
        if candidate is None or now - candidate.received_at > patience.gap_s or patience_s < candidate.patience_s:
            clock.other = _Clock(sent, now, patience_s)
            return clock
        candidate.receive(sent, now)
        if now - candidate.began <= candidate.patience_s:
            return clock
        self.clocks[key] = candidate  # late for long enough
        return candidate


class MessageAges:
    """Ages of messages of other processes; a message older than ``late_s`` is late. Thread-safe.

    All processes of a machine share a clock that counts since its boot. A client can pretend to be such a process, and
    make all real messages seem late: so there is a clock for each topic, and the client spoils only topics on which it
    may publish. If all messages of a machine seem late for 5 s, it was suspended, as virtual machines can be.
    """

    def __init__(self, boot: int, late_s: float) -> None:
        self._boot, self.late_s = boot, late_s
        self.clocks = SenderClocks[tuple[int, str]](_CLOCKS, Patience(believed_s=5.0, set_back_s=5.0, gap_s=1.0))

    def age_s(self, boot: int, topic: str, sent: float, now: float) -> float:
        """Return the age in seconds; ``sent`` and ``now`` count since the boots of their machines.

        The first message of a machine counts as fresh.
        """
        if boot == self._boot:
            return now - sent
        return self.clocks.age_s((boot, topic), sent, 0.0, now, self.late_s)  # 0.0: no other evidence of a wait
