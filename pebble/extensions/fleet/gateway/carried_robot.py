"""A robot for which the gateway forwards: a forwarder and its subscriptions.

Both are made whenever the gateway begins with the robot, so that retained messages count as at the start of a bridge.
"""

from collections.abc import Callable, Iterable, Sequence
from functools import partial
from itertools import islice

from pebble import contract as c
from pebble.contract import INCOMING, OUTGOING, Channel, Kind, codec
from pebble.contract.names import BY, stop_topic, without_name
from pebble.errors import PayloadError
from pebble.forwarding.cycles import PROBE_PERIOD_S
from pebble.forwarding.forwarder import Forwarder
from pebble.forwarding.retained_window import INITIAL_SYNC_S
from pebble.forwarding.routing import Rules, Side
from pebble.forwarding.subjects import Subject, Subjects
from pebble.transports import Handler, Message, Subscription, Transport, clock

#: Between a hub and a broker, for a robot of the hub whose bridge forwards by the paper's table.
GATEWAY = Rules(
    passes={
        Side.LOCAL: frozenset({Kind.STATE, Kind.EVENT, Kind.STREAM, Kind.FLAG}),
        Side.REMOTE: frozenset({Kind.COMMAND, Kind.FLAG, Kind.ACTION, Kind.FEED}),
    },
    leaves_robot=True,
    media=True,
    stored=False,
)
#: Of pictures and of sound: their channel, the flag that allows them, and what requests them.
_MEDIA = ((c.CAMERA, c.MQTT_VIDEO, c.VIDEO_CONTROL), (c.AUDIO, c.MQTT_AUDIO, c.AUDIO_CONTROL))
LARGEST = 1024 * 1024  # bytes of a message; the brokers of `pebble fleet` take no more


class NamedSubjects(Subjects):
    """The meaning of a robot's topics, its *subjects*: by the contract's names, also with the sender's account in them.

    Topics that the robot's own config renames are not known here.
    """

    def _find(self, topic: str) -> Subject | None:
        """Return the subject of a topic. For a topic with an account's name, look up the topic without the name."""
        if not topic.startswith(f"{self._base}/{INCOMING}/{BY}/"):
            return super()._find(topic)
        named = without_name(topic)
        plain = named.topic if named is not None else stop_topic(topic)  # a stop passes with an invalid name, too
        subject = None if plain is None else super()._find(plain)
        if subject is None or subject.kind is not Kind.FLAG:
            return subject
        return self._subject(Kind.COMMAND, subject.channel, subject.qos)  # with a name it is not retained


class Beginning:
    """A stopwatch of starts of forwarding: if a start takes long, commands wait at the broker meanwhile.

    :meth:`aged` adds that time to such commands, so that stale ones are refused. A robot's bridge measures the age of
    commands by pings, which tells nothing here: all robots share a connection that is almost never idle.
    """

    LONG_S = 0.5  # what moves a robot may wait so long
    REST_S = 0.25  # after the start, what had waited is still being read for so long

    def __init__(self) -> None:
        self._began: float | None = None  # None: no forwarding is being started
        self._slow_since, self._slow_until = 0.0, float("-inf")  # the newest start that took long

    def __enter__(self) -> None:
        self._began = clock.since_boot()

    def __exit__(self, *_: object) -> None:
        now, began = clock.since_boot(), self._began
        if began is not None and now - began > self.LONG_S:
            self._slow_since, self._slow_until = began, now + self.REST_S
        self._began = None

    def aged(self, message: Message) -> Message:
        """Return ``message`` with the time since which it may have waited at the broker. Called for each message."""
        began = self._began
        if began is None and self._slow_until == float("-inf"):  # mostly: no start has taken long
            return message
        now = clock.since_boot()
        if began is not None and now - began > self.LONG_S:  # the present start takes long
            since = began
        elif now <= self._slow_until:  # the last long one has just ended
            since = self._slow_since
        else:
            return message
        return Message(message.topic, message.payload, message.qos, message.retain, message.retain_requested, since)


def begin(robots: Sequence["CarriedRobot"], hub: Transport, broker: Transport) -> None:
    """Start forwarding for ``robots``, beginning with the hub's retained messages.

    Retained messages wait until their forwarder is open, but commands from the broker would be dropped: so subscribing
    there is the last step. All robots share the wait for a side, as a round trip takes longer than all else.
    """
    _subscribe(robots, Side.LOCAL, hub, f"{OUTGOING}/#", f"{INCOMING}/flags/#")
    for robot in robots:
        robot.forwarder.open()
    _subscribe(robots, Side.REMOTE, broker, f"{INCOMING}/#")


def _subscribe(robots: Sequence["CarriedRobot"], side: Side, transport: Transport, *below: str) -> None:
    """Subscribe on one side to filters ``below`` the base of each robot, and wait for the retained messages."""
    handlers: dict[str, Handler] = {}
    for robot in robots:
        handlers |= robot.subscribing(side, *below)
    subscriptions = iter(transport.subscribe_all(handlers, echo=False, direct=True))  # in the order of ``handlers``
    if side is Side.REMOTE:  # some brokers send retained messages only for exact names
        transport.ask([flag for robot in robots for flag in robot.subjects.flags])
    for robot in robots:
        robot.subscribed(side, islice(subscriptions, len(below)))  # takes those of this robot


class CarriedRobot:
    """A robot of the hub for which the gateway forwards.

    ``stops_pass()``: True if stops pass by another connection, so that this forwarder leaves them out; called for each
    stop. ``too_large``: called with the topic of a message that is too large for any broker. ``beginning``: measures
    the starts of forwarding, for all robots.
    """

    def __init__(
        self,
        base: str,
        hub: Transport,
        broker: Transport,
        stops_pass: Callable[[], bool],
        too_large: Callable[[str], None],
        clock: Callable[[], float],
        beginning: Beginning,
    ) -> None:
        self.base = base
        self._stops_pass, self._too_large, self._clock, self._beginning = stops_pass, too_large, clock, beginning
        self._subscriptions: list[Subscription] = []
        self._allowed: dict[Channel, bool] = {}  # by a medium's channel: its flag is up
        #: By a medium's channel: the newest request at the broker wants it, or (False) ends it; None: there was none.
        self._requested: dict[Channel, bool | None] = {medium: None for medium, _, _ in _MEDIA}
        self._synchronize_at = self._probe_at = float("-inf")  # when :meth:`tick` does either next
        self.subjects = NamedSubjects(base)
        self.forwarder = Forwarder(
            self.subjects,
            GATEWAY,
            {Side.LOCAL: hub, Side.REMOTE: broker},
            winner=Side.REMOTE,
            on_value=self._on_value,
            clock=clock,
        )

    def subscribing(self, side: Side, *below: str) -> dict[str, Handler]:
        """Return the subscriptions to make on ``side`` and expect retained messages there until :meth:`subscribed`.

        ``below``: filters of metrics below the robot's base topic.
        """
        self.forwarder.sides[side].subscribing()
        return {f"{self.base}/{metrics}": partial(self.receive, side) for metrics in below}

    def subscribed(self, side: Side, subscriptions: Iterable[Subscription]) -> None:
        """Note that the subscriptions are active, and that all retained messages have arrived."""
        self._subscriptions += subscriptions
        self.forwarder.subscribed(side)
        self._synchronize_at = self._clock() + INITIAL_SYNC_S

    def end(self) -> None:
        self.forwarder.shut()
        for subscription in self._subscriptions:
            subscription.close()

    def tick(self, now: float) -> None:
        """Forward the retained messages of both sides, and look for cycles, when either is due."""
        if now >= self._synchronize_at:
            self._synchronize_at = float("inf")
            for side in Side:
                self.forwarder.retained.synchronize(side)
        if now >= self._probe_at:
            self._probe_at = now + PROBE_PERIOD_S
            # REMOTE: only from there commands pass (see GATEWAY).
            self.forwarder.publisher.probe_again((Side.REMOTE,), self.forwarder.retained.value)

    # -- the transports' threads

    def receive(self, side: Side, message: Message) -> None:
        """Forward a message, unless it is too large, a medium that is not wanted, or a stop that comes another way."""
        subject = self.subjects[message.topic]
        if subject is None:
            return
        if len(message.payload) > LARGEST:
            self._too_large(message.topic)
            return
        if side is Side.LOCAL:
            if self._is_wanted(subject.channel):
                self.forwarder.receive(side, message)
        elif not (subject.is_stop and self._stops_pass()):
            self._note_request(subject.channel, message)
            self.forwarder.receive(side, self._beginning.aged(message))

    # -- media

    def _is_wanted(self, channel: Channel | None) -> bool:
        """True if the channel may pass: a medium must be permitted, and not ended by the operator at the broker."""
        if channel not in self._requested:
            return True
        return self._allowed.get(channel, False) and self._requested[channel] is not False

    def _on_value(self, subject: Subject, payload: bytes) -> None:
        for medium, flag, _ in _MEDIA:
            if subject.channel is flag:
                try:
                    self._allowed[medium] = bool(payload) and codec.decode(flag, payload)
                except PayloadError:
                    self._allowed[medium] = False

    def _note_request(self, channel: Channel | None, message: Message) -> None:
        for medium, _, request in _MEDIA:
            if channel is request and not message.retain:
                try:
                    self._requested[medium] = codec.decode(request, message.payload).enabled
                except PayloadError:
                    return
