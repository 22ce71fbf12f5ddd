"""Decodes a channel's messages for services and scripts, and refuses stale and malformed ones."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from pebble.contract import Channel, codec
from pebble.errors import PayloadError
from pebble.runtime.rate_limit import RateLimitedLog
from pebble.transports import Handler, Message
from pebble.transports.counters import Counters

#: Receives a message, its decoded payload, and the names in its topic.
Deliver = Callable[[Message, Any, dict[str, str]], None]


class Refusals:
    """A counter of refused messages, with a log of limited rate."""

    def __init__(self, log: RateLimitedLog, counters: Counters) -> None:
        self._log, self._counters = log, counters

    def stale(self, metric: str) -> None:
        """Count a retained message on a channel whose messages must not be repeated."""
        self._counters.add("stale")
        self._log.warning(f"{metric} retained", "refused a retained message on %s", metric)

    def malformed(self, channel: Channel, error: PayloadError) -> None:
        """Count a message that does not follow the contract."""
        self._counters.add("refused")
        self._log.warning(channel.metric, "refused a message: %s", error)

    def reader(self, channel: Channel, deliver: Deliver, remark: codec.Remark | None = None) -> Handler:
        """Return a handler for ``channel`` that passes valid messages to ``deliver``; ``remark``: see codec.Remark."""
        one_shot, is_pattern = channel.one_shot, channel.is_pattern

        def receive(message: Message) -> None:
            if one_shot and message.retain:
                self.stale(channel.metric)
                return
            names = channel.names(message.topic) if is_pattern else {}
            if is_pattern and not names:  # the filter's + also matches an empty level
                self._counters.add("refused")
                text = "refused a message with an empty level in its topic: %r"
                self._log.warning(f"{channel.metric} unnamed", text, message.topic)
                return
            try:
                value = codec.decode(channel, message.payload, remark)
            except PayloadError as error:
                if codec.is_blank(message.payload):  # a bridge's probe for cycles, which is no mistake
                    self._counters.add("blank")
                else:
                    self.malformed(channel, error)
                return
            deliver(message, value, names)

        return receive
