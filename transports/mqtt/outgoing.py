"""Messages that one MQTT connection has accepted: the backlog before its socket, and those in flight.

Neither class is locked: the lock of the connection is held.
"""

import itertools
import socket
import struct
import sys
import threading
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from typing import NamedTuple

from msgspec import Struct

from pebble.transports.base import Message, QoS

try:
    import fcntl
    import termios
except ImportError:  # Windows has neither
    _can_measure = False
else:
    _can_measure = True

BACKLOG_MESSAGES = 64  # that are not retained
BACKLOG_BYTES = 256 * 1024  # of their payloads; one message may always wait, whatever its size
ROUND_TRIPS = 8  # answer times that are remembered

WINDOW_S = 1.0  # a broker that hangs up because of a message does it so soon after the message was written
SMALL = 256  # bytes that every broker accepts: a smaller message that was accepted counts as so large
TOPICS = 1000  # that are remembered
_TCP_INFO = getattr(socket, "TCP_INFO", None)  # Linux only
_RTT = struct.Struct("@I")  # microseconds
_RTT_AT, _MIN_RTT_AT = 68, 148  # bytes; in struct tcp_info (linux/tcp.h): tcpi_rtt, and since 4.5 tcpi_min_rtt
_NEVER = 0xFFFFFFFF  # no round trip was measured yet


class Backlog:
    """Messages of QoS 0 that wait for a socket which accepts no more, in order (T4).

    When there are too many, a new message replaces the oldest. A retained message is replaced only by a newer one of
    its topic.
    """

    def __init__(self) -> None:
        self.waiting: dict[str | int, Message] = {}  # retained ones by topic, the others by number
        self._numbers = itertools.count()
        self._live_bytes = 0  # of the messages that are not retained,
        self._live = 0  # and how many these are

    @property
    def size(self) -> int:
        """Bytes of all payloads that wait."""
        return sum(len(message.payload) for message in self.waiting.values())

    def put(self, message: Message) -> int:
        """Append ``message``; return how many messages were dropped to make room."""
        if message.retain:
            replaced = self.waiting.pop(message.topic, None) is not None
            self.waiting[message.topic] = message
            return int(replaced)
        self.waiting[next(self._numbers)] = message
        self._live += 1
        self._live_bytes += len(message.payload)
        dropped = 0
        while self._live > 1 and (self._live > BACKLOG_MESSAGES or self._live_bytes > BACKLOG_BYTES):
            self._remove(next(key for key in self.waiting if isinstance(key, int)))
            dropped += 1
        return dropped

    def take(self) -> Message:
        """Remove and return the oldest message."""
        return self._remove(next(iter(self.waiting)))

    def supersede(self, newer: Message) -> int:
        """Drop waiting messages on the topic of ``newer``, which is sent before them (T8); return how many."""
        stale = [
            key
            for key, message in self.waiting.items()
            if message.topic == newer.topic and (newer.retain or not message.retain)
        ]
        for key in stale:
            self._remove(key)
        return len(stale)

    def _remove(self, key: str | int) -> Message:
        message = self.waiting.pop(key)
        if isinstance(key, int):
            self._live -= 1
            self._live_bytes -= len(message.payload)
        return message


class PendingAck(threading.Event):
    """A pending answer of the broker. The loss of the connection completes it, too."""


class _Unconfirmed(Struct):
    """A retained message that the broker may not have, until a PUBACK or the answer to a later ping confirms it."""

    message: Message
    mid: int | None = None  # of a message of QoS 1, once it is written
    ping: int | None = None  # the number of the next ping after a message of QoS 0 was written


class _Ping(NamedTuple):
    """A ping that is not answered yet."""

    sent_at: float
    ack: PendingAck | None  # waits for the answer
    written: dict[str, tuple[float, int]]  # `InFlightTable._written` when it was sent


class InFlightTable:
    """The acknowledgements and answers that the broker owes. Message ids are MQTT's; times are seconds of one clock."""

    def __init__(self) -> None:
        self._round_trips: deque[float] = deque(maxlen=ROUND_TRIPS)  # the latest, seconds
        self._unacked: dict[int, tuple[str, float]] = {}  # by message id: the topic, and when sent
        self._acked_at = float("-inf")  # the newest acknowledgement
        self._unconfirmed: dict[str, _Unconfirmed] = {}  # newest retained message of each topic, oldest first
        self._requests: dict[int, tuple[PendingAck, Sequence[str]]] = {}  # unanswered, with the filters of a SUBSCRIBE
        self.answered: list[PendingAck] = []  # and not completed yet
        self._pings: deque[_Ping] = deque()  # unanswered, oldest first
        # A broker may hang up because a message is forbidden or too large. If it answers a ping, it has accepted all
        # messages before it: only one on another topic, or a larger one, may be the reason for a later loss.
        # By topic: when its largest message was written, and the bytes of that message.
        self._accepted: dict[str, tuple[float, int]] = {}  # of messages before an answered ping
        self._written: dict[str, tuple[float, int]] = {}  # of messages since the newest ping, if larger than accepted
        self._ping_number = self._pong_number = 0  # how many were sent, and answered
        self.lost_bytes = 0  # of the largest message that no answer followed until the connection ended
        self._newest_s = 0.0  # how long the newest answer to a ping took

    # -- messages

    @property
    def unacked(self) -> int:
        """The number of messages of QoS 1 that the broker has not acknowledged."""
        return len(self._unacked)

    @property
    def never_acked(self) -> bool:
        """True if messages of QoS 1 were sent, and the broker has acknowledged none on this connection."""
        return bool(self._unacked) and self._acked_at == float("-inf")

    @property
    def waiting_since(self) -> float | None:
        """Time of sending the oldest message without PUBACK or, if later, of the newest PUBACK; None if none waits."""
        if not self._unacked:
            return None
        _, oldest_sent_at = next(iter(self._unacked.values()))
        return max(oldest_sent_at, self._acked_at)

    def unconfirmed_retained(self) -> list[Message]:
        """Return the retained messages whose arrival at the broker is not confirmed, oldest first."""
        return [entry.message for entry in self._unconfirmed.values()]

    def accept(self, message: Message) -> None:
        """Track ``message``, which is about to be sent or to wait in the backlog."""
        if message.retain:
            self._unconfirmed.pop(message.topic, None)
            self._unconfirmed[message.topic] = _Unconfirmed(message)

    def sent(self, message: Message, mid: int, now: float) -> None:
        """Note that ``message`` was written with the id ``mid``. Must be fast."""
        size, accepted = len(message.payload), self._accepted.get(message.topic)
        if accepted is None or size > accepted[1]:
            _note(self._written, message.topic, now, size)
        if message.qos is QoS.DELIVERED:
            self._unacked[mid] = (message.topic, now)
        if message.retain:
            entry = self._unconfirmed[message.topic]  # made by `accept`
            if message.qos is QoS.DELIVERED:
                entry.mid = mid
            else:
                entry.ping = self._ping_number + 1  # there is no PUBACK: the answer to the next ping confirms it

    def acknowledge(self, mid: int, now: float) -> float | None:
        """Process a PUBACK; return the time when its message was sent, None if the message is unknown."""
        if mid not in self._unacked:
            return None
        self._acked_at = now
        topic, sent_at = self._unacked.pop(mid)
        if topic in self._unconfirmed and self._unconfirmed[topic].mid == mid:
            del self._unconfirmed[topic]
        return sent_at

    def topic_of(self, mid: int) -> str | None:
        """Return the topic of the unacknowledged message of QoS 1 with the id ``mid``; None if there is none."""
        return self._unacked[mid][0] if mid in self._unacked else None

    def first_written(self, now: float) -> dict[str, int]:
        """Return by topic the size of the largest recent message that may be why the broker closed the connection.

        It has accepted all before an answered ping: so only the first on a topic, or the first so large, may be it.
        """
        sizes: dict[str, int] = {}
        for written in [*(ping.written for ping in self._pings), self._written]:
            for topic, (at, size) in written.items():
                if at >= now - WINDOW_S - self.round_trip_s:
                    sizes[topic] = max(size, sizes.get(topic, 0))
        return sizes

    # -- requests and pings

    def ask(self, mid: int, ack: PendingAck, filters: Sequence[str] = ()) -> None:
        """Track a SUBSCRIBE of ``filters``, or an UNSUBSCRIBE."""
        self._requests[mid] = ack, filters

    def answer(self, mid: int) -> Sequence[str]:
        """Process a SUBACK or UNSUBACK; return the filters that it answers."""
        if mid not in self._requests:
            return ()
        ack, filters = self._requests.pop(mid)
        self.answered.append(ack)
        return filters

    @property
    def asked(self) -> list[str]:
        """The filters of all SUBSCRIBEs that are not answered."""
        return [filter_ for _, filters in self._requests.values() for filter_ in filters]

    def complete(self) -> None:
        """Complete the answered requests. Call this after delivering the messages received before the answers."""
        answered, self.answered = self.answered, []
        for ack in answered:
            ack.set()

    def ping(self, now: float, ack: PendingAck | None) -> None:
        """Track a PINGREQ."""
        self._pings.append(_Ping(now, ack, self._written))
        self._written = {}
        self._ping_number += 1

    def pong(self, now: float) -> None:
        """Process a PINGRESP."""
        if not self._pings:
            return
        ping = self._pings.popleft()
        self._pong_number += 1
        self._newest_s = now - ping.sent_at
        self.measured(self._newest_s)
        for topic, (at, size) in ping.written.items():
            _note(self._accepted, topic, at, max(size, SMALL))  # every broker accepts SMALL
        for topic, entry in list(self._unconfirmed.items()):
            if entry.ping and entry.ping <= self._pong_number:
                del self._unconfirmed[topic]
        if ping.ack is not None:
            self.answered.append(ping.ack)

    def measured(self, round_trip_s: float) -> None:
        self._round_trips.append(round_trip_s)

    @property
    def round_trip_s(self) -> float:
        """The shortest recent round trip: a longer one includes a delay, and would let a stall be noticed too late."""
        return min(self._round_trips, default=0.0)

    def newest_answer(self, now: float) -> tuple[int, float]:
        """Return the number of answered pings, and how long the newest took, or an unanswered one already takes."""
        waits = now - self._pings[0].sent_at if self._pings else 0.0
        return self._pong_number, max(self._newest_s, waits)

    def end(self) -> None:
        """Complete all pending answers, because none can come after the connection's end."""
        # The first that no answer has followed: written since the newest answered ping, and before the next ping.
        unanswered = self._pings[0].written if self._pings else self._written
        self.lost_bytes = max((size for _, size in unanswered.values()), default=0)
        self.complete()
        for ack, _ in self._requests.values():
            ack.set()
        for ping in self._pings:
            if ping.ack is not None:
                ping.ack.set()
        self._requests.clear()
        self._pings.clear()


def _note(table: dict[str, tuple[float, int]], topic: str, at: float, size: int) -> None:
    """Note a message in ``table``, which has the largest one of each topic, of TOPICS topics at most."""
    noted = table.get(topic)
    if (noted is None and len(table) < TOPICS) or (noted is not None and size > noted[1]):
        table[topic] = at, size


def unconfirmed_bytes(sock: socket.socket) -> int:
    """Return how many accepted bytes the other side's TCP has not acknowledged, sent or not (SIOCOUTQ).

    0 where the system does not tell.
    """
    return _kernel_bytes(sock, "TIOCOUTQ")


def readable_bytes(sock: socket.socket | None) -> int:
    """Return how many received bytes wait in the kernel (FIONREAD); 0 where the system does not tell."""
    return 0 if sock is None else _kernel_bytes(sock, "FIONREAD")


def _kernel_bytes(sock: socket.socket, request: str) -> int:
    size = bytearray(4)
    if not _can_measure:
        return 0
    with suppress(OSError, ValueError):  # closed, or no TCP
        fcntl.ioctl(sock.fileno(), getattr(termios, request), size)
    return int.from_bytes(size, sys.byteorder)


def shortest_round_trip_s(sock: socket.socket) -> float:
    """Return TCP's shortest round trip of the last minutes, as the kernel measured it; 0 if it does not tell."""
    return _round_trip_s(sock, _MIN_RTT_AT)


def present_round_trip_s(sock: socket.socket) -> float:
    """Return TCP's present round trip, smoothed by the kernel; 0 if it does not tell."""
    return _round_trip_s(sock, _RTT_AT)


def _round_trip_s(sock: socket.socket, at: int) -> float:
    """Return the round trip at the offset ``at`` of the kernel's `tcp_info`; 0 if it does not tell."""
    if _TCP_INFO is None:
        return 0.0
    info = b""
    with suppress(OSError, ValueError):
        info = sock.getsockopt(socket.IPPROTO_TCP, _TCP_INFO, at + _RTT.size)
    if len(info) < at + _RTT.size:
        return 0.0
    (microseconds,) = _RTT.unpack_from(info, at)
    return 0.0 if microseconds == _NEVER else microseconds / 1e6
