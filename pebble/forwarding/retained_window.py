"""Distinguishes retained messages from live ones that also have the retain flag. Pure but for its clock.

Some connections mark live messages with the flag, too: there only the time since the subscription tells.
"""

from collections.abc import Callable

from pebble.transports import Message, Transport

#: Retained messages closely follow the acknowledgement of a subscription: by then they are here even over a slow link.
INITIAL_SYNC_S = 0.5
#: Some brokers send them later: they are all here after a silence this long.
QUIET_S = 0.25
#: The first message of a topic within this time after :meth:`RetainedWindow.subscribed` counts as an old one.
_RETAINED_S = 0.05
#: A broker sends few retained messages at a time, so over a slow link the last ones arrive long after the first. While
#: others with the retain flag keep arriving, a stop with it counts as an old one, but not for longer than this.
_RETAINED_STOPS_S = 10.0


class RetainedWindow:
    """The time in which messages with the retain flag may be old: until shortly after ``transport`` has subscribed."""

    def __init__(self, transport: Transport, clock: Callable[[], float]) -> None:
        self._transport, self._clock = transport, clock
        self._subscribed_at = float("inf")
        self._until = float("inf")  # when messages with the retain flag count as live again; inf: not yet known
        self._stops_until = float("inf")  # the same for stops
        self._newest_at = float("-inf")  # of the messages that may be old

    @property
    def is_arriving(self) -> bool:
        """True if the last retained message came only a moment ago."""
        return self._clock() - self._newest_at < QUIET_S

    def subscribing(self) -> None:
        """Note that the transport subscribes: its retained messages arrive from now on."""
        self._newest_at = float("-inf")
        self._until = self._stops_until = float("inf")

    def subscribed(self) -> None:
        """Note that the subscription is complete, and its retained messages have arrived: the window ends soon."""
        self._subscribed_at = now = self._clock()
        self._until = now + _RETAINED_S
        self._stops_until = max(self._until, self._newest_at + INITIAL_SYNC_S)

    def note(self) -> None:
        """Note a message with the retain flag. While such messages arrive, a stop with the flag may be an old one."""
        now, until = self._clock(), self._stops_until  # `_until`, the end for other messages, is not put off
        if now >= until:  # the window for stops is over
            return
        self._newest_at = now
        if until < float("inf"):  # the subscription is complete: so each message puts the end off
            latest = self._subscribed_at + _RETAINED_STOPS_S  # when the window for stops ends in any case
            self._stops_until = min(max(now + INITIAL_SYNC_S, until), latest)

    def is_old_stop(self, message: Message) -> bool:
        return message.retain and (not self._transport.as_published or self._clock() < self._stops_until)

    def may_be_old(self, message: Message) -> bool:
        """True if ``message`` may be an old retained one: it has the flag, and such messages may still arrive."""
        return message.retain and self._clock() < self._until
