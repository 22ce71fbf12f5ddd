"""Publishes on either side of a forwarder, and recognises its own messages when they come back."""

import itertools
from collections.abc import Callable

import msgspec

from pebble.contract import Kind, codec
from pebble.forwarding.cycles import Cycles
from pebble.forwarding.routing import URGENT, Forward, Side
from pebble.forwarding.side import Sides, SideState
from pebble.forwarding.subjects import Subject, Subjects
from pebble.transports import Message, QoS, State
from pebble.transports.counters import Counters


class Publisher:
    """A publisher of messages, and of probes for cycles; ``both_ways``: kinds that pass in both directions."""

    def __init__(
        self,
        sides: Sides,
        cycles: Cycles,
        subjects: Subjects,
        counters: Counters,
        both_ways: frozenset[Kind],
        *,
        stored: bool,
    ) -> None:
        """Store the arguments; ``stored``: retained messages are published again after an outage."""
        self._sides, self._cycles, self._subjects = sides, cycles, subjects
        self._counters, self._both_ways, self._stored = counters, both_ways, stored

    def publish(self, to: SideState, subject: Subject, message: Message, forward: Forward) -> None:
        topic, payload, transport = message.topic, message.payload, to.transport
        if subject.runs or self._cycles.closed_ways:  # what it starts must run only once, or some topic circulates
            self.note_return(to, subject, message)
        echoing = not transport.exact_echo and subject.is_two_way  # its own broker may send it back
        if echoing:
            to.loopback.expect(topic, payload)
        accepted = transport.publish(
            topic,
            payload,
            qos=forward.qos,
            retain=forward.retain,
            urgent=forward.urgent,
            remember=self._stored,
            shared=subject.kind in self._both_ways,
        )
        if not accepted:
            self._counters.add(f"{to.side.value}: refused")
        if echoing and (not accepted or transport.state is not State.CONNECTED):
            to.loopback.forget(topic)  # it is not on its way, so nothing comes back

    def note_return(self, to: SideState, subject: Subject, message: Message) -> None:
        """Expect ``message``, published to one side, to come back on the other side, if its topic circulates.

        What runs something is expected before a probe shows that it does; drive commands never: they do not pass then.
        """
        origin = to.side.other
        if subject.runs or (not subject.kind.one_shot and (origin, message.topic) in self._cycles.closed_ways):
            self._sides[origin].returns.expect(message.topic, message.payload)

    def is_echo(self, source: SideState, subject: Subject, message: Message) -> bool:
        """True if ``message`` is ours, and came back by another bridge or from a broker without bridge mode.

        Forgets it and all earlier messages of its topic. A retained echo is recognised elsewhere, by its value.
        """
        topic, payload = message.topic, message.payload
        if (source.side, topic) in self._cycles.closed_ways and source.returns.is_echo(topic, payload):
            return True
        # Or it is from the side's own broker, which sends back only what is two-way, and with `exact_echo` nothing.
        if source.transport.exact_echo or message.retain or not subject.is_two_way:
            return False
        return source.loopback.is_echo(topic, payload)

    # -- cycles: what we forward to one side comes back from the other

    def probe_commands(self, *sides: Side) -> None:
        """Send probes, after each connection, that show whether commands and actions from ``sides`` circulate."""
        for side, topic in itertools.product(sides, self._subjects.probed):
            self.probe(side, topic, b"")

    def probe_again(self, sides: tuple[Side, ...], value: Callable[[str], bytes | None]) -> None:
        """Probe topics that circulated; if any circulates, also all commands from ``sides``. Call this once a second.

        ``value`` returns the newest value of a topic. Commands were probed when the connection began, but what brings
        them back may have been set up later.
        """
        for side, topic in self._cycles.poll():
            self.probe(side, topic, value(topic) or b"")
        if self._cycles.closed_ways:
            for side, topic in itertools.product(sides, self._subjects.probed):
                if (side, topic) not in self._cycles.closed_ways:
                    self.probe(side, topic, b"")

    def probe(self, side: Side, topic: str, value: bytes) -> None:
        """Publish a probe on the other side: it returns on ``side`` if something else forwards the topic."""
        subject, target = self._subjects[topic], self._sides[side.other]
        if subject is None or not target.connected:
            return
        # White space behind the topic's value; for a one-shot kind without the value, as a copy of a command would run.
        before = b"" if subject.kind.one_shot else value
        if subject.kind.one_shot or _is_json(value):  # of other values white space would be a part
            probe = before + self._cycles.probe(side, topic)
            target.transport.publish(topic, probe, qos=QoS.DELIVERED, urgent=subject.kind in URGENT)


def _is_json(value: bytes) -> bool:
    """True if white space may follow ``value`` without changing it."""
    try:
        msgspec.json.decode(codec.trim(value))
    except msgspec.DecodeError:
        return False
    return True
