"""The two sides of a forwarder, and the gate that holds messages back until both are ready."""

from collections.abc import Callable
from enum import Enum

from pebble.forwarding.event_buffer import EventBuffer
from pebble.forwarding.loopback_filter import LoopbackFilter
from pebble.forwarding.retained_window import RetainedWindow
from pebble.forwarding.routing import Side
from pebble.transports import State, Transport
from pebble.transports.counters import Counters

#: After a longer outage an earlier value at a restored broker may have been chosen again by an operator.
RESTORED_S = 30.0
#: A message that circulates comes back within this time; the same message later is new.
_RETURN_S = 2.0


class Gate(Enum):
    """The gate between the sides: messages pass both ways, or neither."""

    WAITING = "waiting"  # nothing passes yet; retained messages and events wait
    OPEN = "open"
    SHUT = "shut"  # nothing passes


class SideState:
    """A side: its transport, events that wait for it, messages that it may send back, and its window of retained ones.

    ``wins``: the retained messages of this side count where the two sides differ.
    """

    def __init__(
        self, side: Side, transport: Transport, counters: Counters, clock: Callable[[], float], *, wins: bool
    ) -> None:
        self.side, self.transport = side, transport
        self.count_forwarded = counters.adder(f"{side.value}: forwarded")
        self.events = EventBuffer(transport, counters, clock=clock)
        self.window = RetainedWindow(transport, clock)
        self.loopback = LoopbackFilter(clock)  # what a broker without bridge mode sends back
        self.returns = LoopbackFilter(clock, _RETURN_S)  # what we forward on topics that circulate: it comes back once
        self.seen: set[str] = set()  # two-way topics that have had a message since we subscribed
        self.restarted = False  # its connection was lost; the reconciliation does not know yet
        self._clock, self._wins = clock, wins
        self._lost_at = float("-inf")  # when its state was last another than connected; -inf: never
        # On the side that wins: its broker has restored older retained messages. On the other side: it may have.
        self._went_back = False  # False again once this side's retained messages have arrived

    @property
    def connected(self) -> bool:
        return self.transport.state is State.CONNECTED

    def subscribing(self) -> None:
        """Note that subscribing to this side begins: its retained messages arrive from now on."""
        self.window.subscribing()
        self.seen.clear()

    def watch(self, state: State) -> None:
        """Follow the transport's state."""
        self.events.watch(state)
        if state is not State.CONNECTED:
            self.subscribing()  # the transport does so at the next connection
            self.restarted = True
            self._lost_at = self._clock()
            # A broker that ended may restore a save. On the side that does not win it counts as having done so, and
            # at once: old messages may come before CONNECTED. The side that wins needs `went_back`, known at CONNECTED.
            self._went_back = not self._wins and self.transport.was_ended
        elif self._wins:
            self._went_back = self._was_brief and self.transport.went_back  # brief: see RESTORED_S

    @property
    def has_gone_back(self) -> bool:
        """True if an older retained value of this side was restored by its broker, not set again by a program."""
        if not self._went_back:
            return False
        return self._wins or self._was_brief or self.transport.was_ended

    def arrived(self) -> None:
        """Note that the retained messages of this side have arrived.

        An older value that comes from now on counts as set again by a program, not as restored by the side's broker.
        """
        self._went_back = False

    @property
    def _was_brief(self) -> bool:
        return self._clock() - self._lost_at < RESTORED_S


class Sides(dict[Side, SideState]):
    """Both sides, and the gate between them."""

    gate: Gate = Gate.WAITING
