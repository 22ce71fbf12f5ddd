"""A second connection of the bridge to the operators' broker, only for stops.

A broker sends a client's messages in order, and drops new ones while too many wait. So one account that floods a robot
with permitted messages would delay, or lose, the stop of another. On a connection that is subscribed to nothing else no
stop waits. The main connection still receives every stop, too. A stop with a name passes both times, as motor owners
recognise its name. Of stops without a name each counts once, whichever way is faster.
"""

import logging
import threading
from collections import deque
from collections.abc import Callable, Iterable
from enum import Enum
from typing import NamedTuple

from pebble.contract.codec import MAX_COMMAND_BYTES
from pebble.services.mqtt_bridge.passed_stops import is_named
from pebble.transports import Message, State, Transport

log = logging.getLogger(__name__)

_COPIES, _DROPPED = 1024, 64  # stops whose copy is expected, and that were recognised as copies just now
_BEHIND_S = 60.0  # so long after its stop the main connection's copy is one; behind a flood 38 s were seen
_PROMPT_S = 2.0  # and that of the stop connection, where nothing is in front of it
_GRACE_S = 5.0  # for a connection to be made, while the main one is there
_AGAIN_S = 600.0  # after which it is tried again
_KICKED_S = 2.0  # who loses the main connection so soon after the other was made may have been allowed only one
_KICKS = 3  # in a row


class Way(Enum):
    """The connection over which a stop came."""

    MAIN = "main"
    STOPS = "stops"


class _Expected(NamedTuple):
    """A stop whose copy may come, until a time."""

    key: int  # a hash of its topic and payload
    until: float


class Copies:
    """A memory that recognises the second copy of a stop without a name, which comes both ways; thread-safe.

    A stop may be taken for the copy of an equal earlier one. It is not lost: if the stop connection was dead before
    that was noticed, :meth:`lost` returns the stops that only the main connection may have received meanwhile.
    """

    def __init__(self, clock: Callable[[], float], notices_s: float) -> None:
        """Store the arguments; ``notices_s``: seconds after which a lost connection is noticed."""
        self._clock, self._notices_s = clock, notices_s
        self._lock = threading.Lock()
        self._expected = {way: deque[_Expected](maxlen=_COPIES) for way in Way}  # by the way on which the copy comes
        self._dropped = deque[tuple[float, Message]](maxlen=_DROPPED)  # copies on the main connection, and their times

    def is_copy(self, way: Way, message: Message, *, comes_both_ways: bool) -> bool:
        """True if this stop came the other way before; then forget it, else remember it.

        ``comes_both_ways``: the other connection receives stops now.
        """
        key, now, expected = hash((message.topic, message.payload)), self._clock(), self._expected[way]
        with self._lock:
            while expected and expected[0].until < now:
                expected.popleft()
            copy = next((entry for entry in expected if entry.key == key), None)
            if copy is not None:
                expected.remove(copy)
                if way is Way.MAIN:
                    short = message.payload[:MAX_COMMAND_BYTES]  # cut off it is a stop still, but has no name
                    self._dropped.append((now, Message(message.topic, short, message.qos)))
                return True
            if comes_both_ways and not message.retain:  # with the flag it may be an old one, of which there is no copy
                other_way, wait_s = (Way.STOPS, _PROMPT_S) if way is Way.MAIN else (Way.MAIN, _BEHIND_S)
                self._expected[other_way].append(_Expected(key, now + wait_s))
            return False

    def forget(self) -> None:
        """Forget all stops, because a connection was lost: no copy is expected."""
        with self._lock:
            for expected in self._expected.values():
                expected.clear()

    def lost(self) -> list[Message]:
        """Note that the stop connection was lost; return the stops that only the main connection may have received."""
        self.forget()
        with self._lock:
            since, dropped = self._clock() - self._notices_s, list(self._dropped)
            self._dropped.clear()
        return [message for at, message in dropped if at >= since]


class StopConnection:
    """The second connection, as long as the broker accepts it.

    ``pass_on`` gets each stop of this connection, on its thread, except stops without a name that came over the main
    connection before. ``main`` returns True while the main connection exists, and messages are forwarded. Call
    :meth:`check` once a second and :meth:`main_lost`, on the service's thread.
    """

    def __init__(
        self,
        transport: Transport,
        filters: Iterable[str],
        pass_on: Callable[[Message], None],
        main: Callable[[], bool],
        clock: Callable[[], float],
        *,
        notices_s: float,
        grace_s: float = _GRACE_S,
        wanted: Callable[[], bool] = lambda: True,
    ) -> None:
        """Store the arguments; ``notices_s``: seconds after which a lost connection is noticed.

        ``grace_s``: seconds for which it tries to connect. ``wanted`` returns True while this is worth its cost.
        """
        self._grace_s, self._wanted = grace_s, wanted
        self._transport, self._filters, self._clock = transport, tuple(filters), clock
        self._pass_on, self._main = pass_on, main
        self._copies = Copies(clock, notices_s)
        self._failing_since = float("-inf")  # since when it fails: when it was last well, or not needed
        self._off_until = float("-inf")  # when it is tried again
        self._connected_at = float("inf")  # when it was made last; inf: never
        self._kicks = 0  # how often in a row the broker ended the main connection soon after this one was made
        transport.policy.is_stop = lambda _topic: True  # it is subscribed to nothing else
        self._reported: bool | None = None  # the log says that it is there, or that it is not
        transport.on_state(self._on_state)

    @property
    def listens(self) -> bool:
        """True if stops arrive on this connection."""
        return self._transport.state is State.CONNECTED and not self._transport.not_received

    def is_copy(self, message: Message) -> bool:
        """True if this stop of the main connection has no name and came over this one before: see `Copies.is_copy`."""
        return not is_named(message.payload) and self._copies.is_copy(Way.MAIN, message, comes_both_ways=self.listens)

    def check(self) -> None:
        """Open the connection while it is wanted; give it up if it is not subscribed although the main one is there."""
        now = self._clock()
        if not self._wanted():
            self.close()
        elif not self._main():
            self._failing_since = now
        elif self._transport.state is State.CLOSED:
            if now >= self._off_until:
                self._failing_since = now
                self._transport.open(timeout=0.0)
                self._transport.subscribe_all(dict.fromkeys(self._filters, self._receive), direct=True)
        elif self.listens:
            self._failing_since = now
            self._report(True)
        elif now - self._failing_since > self._grace_s:
            self._give_up(self._transport.not_received or self._transport.problem, _AGAIN_S)

    def main_lost(self, *, ended: bool) -> None:
        """Note that the main connection is lost; ``ended``: the broker has closed it."""
        self._copies.forget()
        if self._clock() - self._connected_at >= _KICKED_S:  # not because of this one; never true before it was made
            self._kicks = 0
        elif ended and self.listens:
            self._kicks += 1
            if self._kicks >= _KICKS:
                self._give_up("the broker ends the main one for it", float("inf"))

    def close(self) -> None:
        self._transport.close()

    def _give_up(self, why: str, seconds: float) -> None:
        self._off_until = self._clock() + seconds
        self.close()
        self._report(False, why)

    def _report(self, exists: bool, why: str = "") -> None:
        if exists is self._reported:
            return
        self._reported = exists
        if exists:
            log.info("emergency stops have a connection of their own")
        else:
            log.warning("emergency stops have no connection of their own, and may wait behind a flood: %s", why)

    # -- the transport's thread

    def _receive(self, message: Message) -> None:
        if message.retain:  # an old one: live ones have no such mark on this connection
            return
        if is_named(message.payload) or not self._copies.is_copy(Way.STOPS, message, comes_both_ways=self._main()):
            self._pass_on(message)

    def _on_state(self, state: State) -> None:
        if state is State.CONNECTED:
            self._connected_at = self._clock()
            return
        doubtful = self._copies.lost()  # came over the main connection, dropped as copies, perhaps wrongly
        if state is State.CONNECTING:  # it was lost; if it is CLOSED, we have ended it
            for message in doubtful:
                self._pass_on(message)
