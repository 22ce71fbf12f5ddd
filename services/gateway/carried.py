"""One robot for as long as this gateway carries it: a forwarder of its own, made anew each time, and its subscriptions.

Nothing of an earlier time is left in it, because another gateway may have carried the robot meanwhile: what counts is
what hub and broker retain now.
"""

import time
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from itertools import islice

from pebble.contract import (
    AUDIO,
    AUDIO_CONTROL,
    CAMERA,
    INCOMING,
    MQTT_AUDIO,
    MQTT_VIDEO,
    OUTGOING,
    VIDEO_CONTROL,
    Channel,
    Kind,
    codec,
)
from pebble.contract.names import BY, stop_topic, without_name
from pebble.errors import PayloadError
from pebble.forwarding.forwarder import Forwarder
from pebble.forwarding.routing import GATEWAY, Side
from pebble.forwarding.subjects import Subject, Subjects
from pebble.services.gateway.pace import LARGEST, MOST_EACH, MOST_TOGETHER, Pace
from pebble.transports import Handler, Message, State, Subscription, Transport, clock

#: What the robot sends of each medium, by what allows and what requests it.
_MEDIA = ((CAMERA, MQTT_VIDEO, VIDEO_CONTROL), (AUDIO, MQTT_AUDIO, AUDIO_CONTROL))


class NamedSubjects(Subjects):
    """Subjects of a robot that renames nothing, also behind the name of a sender, which passes as it is."""

    def _find(self, topic: str) -> Subject | None:
        if not topic.startswith(f"{self._base}/{INCOMING}/{BY}/"):
            return super()._find(topic)
        named = without_name(topic)
        plain = named.topic if named is not None else stop_topic(topic)
        found = None if plain is None else super()._find(plain)
        if found is None or found.kind is not Kind.FLAG:
            return found
        return self._subject(Kind.COMMAND, found.channel, found.qos)  # nothing is retained behind a name


class Beginning:
    """Tells since when commands may have waited behind what the broker retains for a robot that begins.

    They share a connection with it, on which something of ours is nearly always on its way, so pings do not tell.
    """

    LONG_S, REST_S = 0.5, 0.25  # what moves may wait so long; so long after it what had waited is still being read

    def __init__(self) -> None:
        self._began: float | None = None  # None: none begins
        self._slow, self._until = 0.0, float("-inf")  # the newest one that took long: since, until

    def __enter__(self) -> None:
        self._began = clock.since_boot()

    def __exit__(self, *_: object) -> None:
        now, began = clock.since_boot(), self._began
        if began is not None and now - began > self.LONG_S:
            self._slow, self._until = began, now + self.REST_S
        self._began = None

    def aged(self, message: Message) -> Message:
        """``message`` with the time since when it may have waited. Hot."""
        began = self._began
        if began is None and self._until == float("-inf"):
            return message
        now, since = clock.since_boot(), None
        if began is not None and now - began > self.LONG_S:
            since = began
        elif now <= self._until:
            since = self._slow
        if since is None:
            return message
        return Message(message.topic, message.payload, message.qos, message.retain, message.retain_requested, since)


def begin(robots: Sequence["Carried"], hub: Transport, broker: Transport) -> list["Carried"]:
    """Forward for each of ``robots`` from now on; first what the hub retains. Waits, bounded, for both sides: once for
    all of them, as a round trip takes longer than all else that a robot needs. Returns those that are carried still.
    """
    _subscribe(robots, Side.LOCAL, hub, f"{OUTGOING}/#", f"{INCOMING}/flags/#")
    held = [one for one in robots if one.open()]
    _subscribe(held, Side.REMOTE, broker, f"{INCOMING}/#")
    return held


def _subscribe(robots: Sequence["Carried"], side: Side, transport: Transport, *below: str) -> None:
    handlers: dict[str, Handler] = {}
    for one in robots:
        handlers |= one.subscribing(side, *below)
    made = iter(transport.subscribe_all(handlers, echo=False, direct=True))
    transport.ask([flag for one in robots for flag in one.subjects.flags] if side is Side.REMOTE else [])
    for one in robots:
        one.subscribed(side, islice(made, len(below)))


class Carried:
    """A robot of the hub, since ``since``.

    ``holds`` is asked for each message: whether this gateway carries it at this moment, and has done so since then.
    """

    def __init__(
        self,
        base: str,
        since: float,
        hub: Transport,
        broker: Transport,
        holds: Callable[[], bool],
        clock: Callable[[], float] = time.monotonic,
        flooded: Callable[[str], None] = lambda _topic: None,
        beginning: Beginning | None = None,
    ) -> None:
        self.base, self.since = base, since
        self._holds = holds
        self._beginning = Beginning() if beginning is None else beginning
        self._paces, self._flooded = {side: Pace(clock, MOST_EACH, MOST_TOGETHER) for side in Side}, flooded
        self._subscriptions: list[Subscription] = []
        #: By the channel of each medium: what allows it, and whether it was requested at the broker; None: not known.
        self._allowed: dict[Channel, bool] = {}
        self._requested: dict[Channel, bool | None] = {medium: None for medium, _, _ in _MEDIA}
        self.subjects = NamedSubjects(base)
        self.forwarder = Forwarder(
            self.subjects,
            GATEWAY,
            {Side.LOCAL: hub, Side.REMOTE: broker},
            winner=Side.REMOTE,
            on_value=self._on_value,
            clock=clock,
        )

    def open(self) -> bool:
        """Forward from now on; first what has waited. False: this gateway does not carry the robot any more."""
        if not self._holds():
            return False
        self.forwarder.open()
        return True

    def subscribing(self, side: Side, *below: str) -> dict[str, Handler]:
        """What to subscribe to on ``side`` below the robot's base; its retained messages arrive from now on."""
        self.forwarder.sides[side].subscribing()
        return {f"{self.base}/{one}": partial(self.receive, side) for one in below}

    def subscribed(self, side: Side, subscriptions: Iterable[Subscription]) -> None:
        """These are active, and what is retained there has arrived."""
        self._subscriptions += subscriptions
        self.forwarder.subscribed(side)

    def end(self) -> None:
        self.forwarder.shut()
        subscriptions, self._subscriptions = self._subscriptions, []
        for one in subscriptions:
            one.close()

    def hub_changed(self, state: State) -> None:
        """The connection to the hub was lost, or is back; then what it retains comes again."""
        self.forwarder.sides[Side.LOCAL].watch(state)
        if state is State.CONNECTED:
            self.forwarder.subscribed(Side.LOCAL)

    def synchronize(self) -> None:
        """What both sides retain has arrived."""
        if self._holds():
            for side in Side:
                self.forwarder.retained.synchronize(side)

    def probe(self) -> None:
        """Once a second: find out whether what circulated does so still."""
        if self._holds():
            self.forwarder.publisher.probe_again((Side.REMOTE,), self.forwarder.retained.value)

    # -- the transports' threads

    def receive(self, side: Side, message: Message) -> None:
        """Pass a message on, unless this gateway does not carry the robot now."""
        is_old = self.forwarder.sides[side].window.may_be_old(message)  # all that is retained comes at once
        if len(message.payload) <= LARGEST and (is_old or self._paces[side].takes(message, message.topic)):
            self._pass(side, message)
        else:
            self._flooded(message.topic)

    def pass_waiting(self) -> None:
        """Pass what was too much in the second before."""
        for side, pace in self._paces.items():
            for message in pace.due():
                self._pass(side, message)

    def _pass(self, side: Side, message: Message) -> None:
        if not self._holds():
            return
        subject = self.subjects[message.topic]
        channel = None if subject is None else subject.channel
        if channel is not None and (side is Side.REMOTE or channel in self._requested):
            if side is Side.REMOTE:
                self._note_request(channel, message)
            elif not self._is_wanted(channel):
                return
        self.forwarder.receive(side, self._beginning.aged(message) if side is Side.REMOTE else message)

    # -- media

    def _is_wanted(self, medium: Channel) -> bool:
        """Whether pictures or sound pass. After a change of gateways it is not known who has requested them."""
        return self._allowed.get(medium, False) and self._requested[medium] is not False

    def _on_value(self, subject: Subject, payload: bytes) -> None:
        for medium, flag, _ in _MEDIA:
            if subject.channel is flag:
                try:
                    self._allowed[medium] = bool(payload) and codec.decode(flag, payload)
                except PayloadError:
                    self._allowed[medium] = False

    def _note_request(self, channel: Channel, message: Message) -> None:
        for medium, _, request in _MEDIA:
            if channel is request and not message.retain:
                try:
                    self._requested[medium] = codec.decode(request, message.payload).enabled
                except PayloadError:
                    return
