"""Names and decodes the messages of a channel, and refuses what is stale or malformed: for services and scripts."""

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
    """Counts what is refused, and logs it at a limited rate."""

    def __init__(self, log: RateLimitedLog, counters: Counters) -> None:
        self._log, self._counters = log, counters

    def stale(self, what: str) -> None:
        self._counters.add("stale")
        self._log.warning(f"{what} retained", "refused a retained message on %s", what)

    def malformed(self, channel: Channel, error: PayloadError) -> None:
        self._counters.add("refused")
        self._log.warning(channel.metric, "refused a message: %s", error)

    def reader(self, channel: Channel, deliver: Deliver, remark: codec.Remark | None = None) -> Handler:
        """Return what a subscription to ``channel`` is to call: it passes what is valid to ``deliver``."""
        one_shot, is_pattern = channel.one_shot, channel.is_pattern

        def receive(message: Message) -> None:
            if one_shot and message.retain:
                self.stale(channel.metric)
                return
            names = channel.names(message.topic) if is_pattern else {}
            if is_pattern and not names:  # the filter's + also matches an empty level
                self._counters.add("refused")
                what = "refused a message with an empty level in its topic: %r"
                self._log.warning(f"{channel.metric} unnamed", what, message.topic)
                return
            try:
                value = codec.decode(channel, message.payload, remark)
            except PayloadError as error:
                if codec.is_blank(message.payload):
                    self._counters.add("blank")
                else:
                    self.malformed(channel, error)
                return
            deliver(message, value, names)

        return receive
