"""The bridge as a process: forwarding, heartbeat, same-broker probe, system actions and media requests."""

from collections.abc import Iterable, Mapping
from contextlib import suppress
from functools import partial
from typing import TYPE_CHECKING, Any

import msgspec

from pebble import contract as c
from pebble.contract import codec
from pebble.contract.levels import LEVELS
from pebble.contract.names import with_name
from pebble.contract.payloads import ControlState
from pebble.errors import ConfigError, PayloadError
from pebble.extension import part
from pebble.forwarding.forwarder import Routed, barrier
from pebble.forwarding.names import Names
from pebble.forwarding.observer import ROBOT, Observer, Observers, PrivateTopics, Step, steps_of
from pebble.forwarding.retained_window import INITIAL_SYNC_S
from pebble.forwarding.routing import TABLE_A1, Drop, Side
from pebble.forwarding.service import CHECK_SOON_S, ForwardingService
from pebble.forwarding.side import Gate
from pebble.forwarding.subjects import Subject
from pebble.runtime.connections import remote_transport, stops_transport
from pebble.runtime.parent import Notifier
from pebble.runtime.service import every
from pebble.runtime.timers import Timer
from pebble.services.mqtt_bridge.heartbeat import Heartbeat
from pebble.services.mqtt_bridge.leftovers import Leftovers
from pebble.services.mqtt_bridge.motor_owners import CHECK_S, MotorOwners
from pebble.services.mqtt_bridge.own_requests import OwnRequests
from pebble.services.mqtt_bridge.passed_stops import REPEAT_S, PassedStops, is_named, named
from pebble.services.mqtt_bridge.same_broker import SameBrokerProbe, now_ms
from pebble.services.mqtt_bridge.uplink import POLL_S, uplink_of
from pebble.services.mqtt_bridge.vouching import PERIOD_S, Vouching
from pebble.transports import Message, QoS, State, Transport

if TYPE_CHECKING:
    from pebble.services.mqtt_bridge.stop_connection import StopConnection

#: After the barrier, for brokers that pass messages between connections with a delay.
_PROBE_WAIT_S = 0.1
_AGAIN_WAIT_S = 1.0  # once a probe has come back: its way may be slow
_RETRY_S = 1.0
_IGNORED = (Drop.ECHO, Drop.LATE, Drop.PROBE)  # dropped messages that are no request, or are too late to be one
LEFTOVERS_AFTER_S = 30.0  # by then all services have published what they retain; so long after the start, or later
_LOGGED = 200  # characters of a topic
_CHECK_STOPS_S = 1.0
_NOTICED_S = 1.0  # by so much later than its limit a silence is noticed
_ARRIVAL_S = 0.25  # between two looks whether a probe has arrived, for which the mirror waits
_THIN_GRACE_S = 30.0  # over a thin link, while a client floods it
ASK_S = 0.2  # between two questions about what is left at the remote broker


class MqttBridge(ForwardingService):
    """The bridge: it forwards by Table A.1, once it knows that its two sides are not one broker."""

    name = "mqtt_bridge"
    client_name = "local-bridge"
    rules = TABLE_A1
    probed_sides = (Side.REMOTE,)
    arriving_s = 2.0

    def __init__(self, *arguments: Any, **options: Any) -> None:
        """Make the parts of the bridge, and set the rules of its two transports."""
        super().__init__(*arguments, **options)
        section = self.config.services.mqtt_bridge
        self._heartbeat = Heartbeat(self.addresses[c.ONLINE]) if section.heartbeat.enabled else None
        self._same_broker = SameBrokerProbe(self.config, self.transport, self.remote, self.clock)

        # The motor owners: are they reached, have they confirmed the stops, and who has control?
        notifier = Notifier()
        self._owners = MotorOwners(self.config.base, self.config.motor_owners, notifier)
        self._passed_stops = PassedStops(self.config.motor_owners, self.clock)
        self._observers = Observers(self.config, self.clock)  # of extensions: they see what passes
        deciding_owner = min(self.config.motor_owners, default="")  # of several, the first by name gives control
        self._control_topic = c.CONTROL_STATE.topic(self.config.base, owner=deciding_owner) if deciding_owner else ""

        # Private topics, which only an extension has, are never forwarded; nor is a group with a command on one.
        private = next((extension.private for extension in self.config.installed if extension.private), "")
        self._private = (part(private) if private else PrivateTopics)(self.config.base)
        self.forwarder.stays = self._private.stays

        # Towards operators: what is sent when, who carries out requests to the bridge, what the broker has to forget.
        self._is_thin = section.link.profile != "wide"  # or may become so
        self._uplink = uplink_of(self.config, self.addresses, self.remote, self.forwarder, self.clock)
        self._requests = OwnRequests(self, self.forwarder.mirroring, self._uplink.note_drive)
        self._leftovers = Leftovers(self.config.base, self.subjects, self.remote, *self._uplink.channels)
        self._leftover_timer: Timer | None = None

        # The period of which the motor owners have all messages. Without pings only a long silence shows a loss.
        sends_pings = section.remote is None or section.remote.kind == "mqtt"
        self._vouching = Vouching(self.remote, self.clock(), None if sends_pings else self._silence_s)
        self._local_changes = 0  # how often the local connection was made or lost

        # Stops have a connection of their own, if there can be one.
        self._stop_topic = c.ESTOP.topic(self.config.base)
        self._stops = self._make_stops()

        # Strangers can invent any number of topics, and plant retained messages: nothing is stored for these.
        self.transport.policy.is_invented = lambda topic: self.subjects.invented(topic.encode()) is not None
        self.remote.policy.skips_retained = partial(self.forwarder.skips_retained, Side.REMOTE)
        # A retained message may come after a live one of its topic, which may be our own: the forwarder decides.
        self.remote.policy.delivers_late = True

    @property
    def winner(self) -> Side:
        """Side whose retained messages count: remote; local at level `named`, where those of operators do not pass."""
        return Side.LOCAL if self.config.security.named else Side.REMOTE

    @property
    def _silence_s(self) -> float:
        """Seconds of silence after which the remote side is lost."""
        section = self.config.services.mqtt_bridge
        return section.remote_mqtt.silence_seconds if section.remote is None else section.remote.lease_ms / 1000

    def make_steps(self) -> Mapping[str, Step]:
        return steps_of(self.config)

    def make_names(self) -> Names | None:  # the finder of the senders of messages on the remote side
        security = self.config.security
        if not security.named:
            return None
        for extension in self.config.installed:
            if extension.names:
                names: Names = part(extension.names)(self.config.base, self.subjects, security.unnamed)
                return names
        raise ConfigError("security.level: named is of the extension fleet, which is not installed")

    def make_remote(self) -> Transport:
        enabled = self.config.services.mqtt_bridge.heartbeat.enabled
        will = Heartbeat(self.addresses[c.ONLINE]).will(now_ms()) if enabled else None
        return remote_transport(self.config, "remote-bridge", will=will)

    def _make_stops(self) -> "StopConnection | None":
        transport = stops_transport(self.config)
        if transport is None:
            return None
        from pebble.services.mqtt_bridge.stop_connection import StopConnection  # only who needs it pays for it

        filters = [self._stop_topic]
        if self.config.security.named:
            filters.append(with_name(self._stop_topic, "+"))
        make = partial(StopConnection, transport, filters, self._pass_stop, self._forwards, self.clock)
        if not self._is_thin:  # a thin link carries this connection only while a client floods it, see ``wanted``
            return make(notices_s=self._silence_s + _NOTICED_S)
        transport.suit_link(thin=True)
        notices_s = max(self._silence_s, LEVELS["thin"].silent_s) + _NOTICED_S
        return make(notices_s=notices_s, grace_s=_THIN_GRACE_S, wanted=lambda: self._uplink.is_flooded)

    def start(self) -> None:
        super().start()
        if self._stops is not None:
            self.on_stop(self._stops.close)
            self.timers.add(self.clock(), self._stops.check, period=_CHECK_STOPS_S)
        self._observers.tell(Observer.start)
        self.on_stop(partial(self._observers.tell, Observer.close))
        if self._heartbeat is not None:
            interval = self.config.services.mqtt_bridge.heartbeat.interval_seconds
            self.timers.add(self.clock(), self._publish_heartbeat, period=interval)
        if self._is_thin:
            self.timers.add(self.clock(), self._follow_link, period=POLL_S)
        if self._same_broker.announces:
            self.timers.add(self.clock(), self._same_broker.report_arrival, period=_ARRIVAL_S)
        self._look_for_leftovers_later()

    # -- the service's thread

    def _publish_heartbeat(self, *, at_once: bool = False) -> None:
        if self._heartbeat is None or not (at_once or self._uplink.heartbeat_due()):
            return
        if not at_once and self._subscribes_soon:
            return
        self._heartbeat.publish(self.remote, now_ms(), self._uplink.heartbeat_qos)

    @property
    def _subscribes_soon(self) -> bool:
        """True if the heartbeat must wait until we subscribe: operators that see it send commands at once."""
        subscribed = self.subscriptions[Side.REMOTE] or self.forwarder.gate is Gate.SHUT
        return not subscribed and self._same_broker.both_connected

    def _follow_link(self) -> None:
        """Measure the link, and send messages that have waited for room."""
        if self._uplink.poll():
            self._publish_heartbeat()

    def _look_for_leftovers_later(self) -> None:
        """Look for messages that only the remote side retains, when all services have had time to publish theirs."""
        if self._leftovers.done:
            return
        if self._leftover_timer is not None:
            self._leftover_timer.cancel()
        self._leftovers.begin()
        self._leftover_timer = self.call_at(self.clock() + LEFTOVERS_AFTER_S, self._look_for_leftovers)

    def _look_for_leftovers(self) -> None:
        if self.forwarder.gate is not Gate.OPEN or not self._same_broker.both_connected:
            self._look_for_leftovers_later()
            return
        has_asked = self._leftovers.ask_next()
        wait_s, then = INITIAL_SYNC_S, self._remove_leftovers
        if has_asked:  # more may be left
            wait_s, then = self._uplink.pause(ASK_S), self._look_for_leftovers
        self._leftover_timer = self.call_at(self.clock() + wait_s, then)

    def _remove_leftovers(self) -> None:
        """Remove the retained topics that only the remote broker has; look later if nothing can be forwarded now."""
        if self.forwarder.gate is not Gate.OPEN or not self._same_broker.both_connected:
            self._look_for_leftovers_later()
            return
        removed = self._leftovers.remove(partial(self.forwarder.retained.remove, Side.REMOTE))
        if removed:
            few = ", ".join(topic[:_LOGGED] for topic in removed[:3]) + (", …" if len(removed) > 3 else "")
            self.log.info("removed %d retained topics that the robot no longer has: %s", len(removed), few)

    def connected(self, side: Side, epoch: int) -> None:  # see ForwardingService
        if side is Side.REMOTE:
            if self.forwarder.gate is Gate.SHUT:  # else subscribe_remote() does that, below or after the check
                self._publish_heartbeat(at_once=True)
        else:
            barrier(self.transport, self._same_broker.topic)  # until the robot's retained messages have arrived
            self.forwarder.subscribed(Side.LOCAL)
            self.synchronize_later(Side.LOCAL)
        if self.forwarder.gate is not Gate.OPEN:
            self._check_brokers()
            return
        self._same_broker.send()  # the new connection may lead to another broker
        if side is Side.REMOTE and epoch == self.epoch:  # else this connection was lost: the next one subscribes
            self.subscribe_remote()

    def subscribe_remote(self) -> None:
        super().subscribe_remote()
        self._publish_heartbeat(at_once=True)

    def _forwards(self) -> bool:
        return self.forwarder.gate is Gate.OPEN and self.remote.state is State.CONNECTED

    def disconnected(self, side: Side) -> None:
        if side is Side.REMOTE:
            self._same_broker.report_none()
            if self._stops is not None:
                self._stops.main_lost(ended=self.remote.was_ended)
        self._look_for_leftovers_later()
        super().disconnected(side)

    def await_retained(self) -> None:
        self.remote.ask(self.subjects.flags)

    def _check_brokers(self) -> None:
        """Open the forwarder's gate if the two sides cannot be one broker; otherwise begin a round of probing."""
        if not self._same_broker.possible:
            if self._same_broker.announces:
                self._same_broker.send()  # our mirror learns by it whether its broker is the remote one
            self._begin_forwarding()
        if self.forwarder.gate is Gate.OPEN or not self._same_broker.both_connected:
            return
        # A message to a topic that is subscribed to anyway comes back after all probes that were sent before it.
        round_ = self._same_broker.begin_round(self.subjects.topics(c.DRIVE)[0])
        if round_ is not None:  # else a connection is missing: the next one begins a round
            wait_s = _PROBE_WAIT_S if self.forwarder.gate is Gate.WAITING else _AGAIN_WAIT_S  # SHUT: a probe came back
            self.call_at(self.clock() + wait_s, partial(self._end_round, round_))

    def _end_round(self, round_: int) -> None:
        """Open the forwarder's gate if no probe came back. If a connection was lost, another round begins."""
        if self._same_broker.proves_two_brokers(round_):
            self._begin_forwarding()

    def _begin_forwarding(self) -> None:  # does nothing if it forwards already
        if self.remote.state is not State.CONNECTED or self.forwarder.gate is Gate.OPEN:
            return
        was_shut = self.forwarder.gate is Gate.SHUT
        self.forwarder.open()
        if was_shut:  # what was received meanwhile was dropped: a new subscription brings the retained messages again
            self.unsubscribe(Side.LOCAL)
            self.forwarder.sides[Side.LOCAL].subscribing()  # as at a new connection
            self.subscribe_local()
            self.forwarder.subscribed(Side.LOCAL)
        self.subscribe_remote()  # only now; the local side was subscribed to while the gate was WAITING
        self.log.info("forwarding between the robot and its remote side")

    def found_one_broker(self) -> None:
        self.forward_nothing(CHECK_SOON_S)
        self._publish_heartbeat(at_once=True)
        self.log.info(
            "the local and the remote side are one broker, or something else forwards outgoing/# to the local one: "
            "nothing is mirrored"
        )
        # The robot's retained flags would wait for those of the remote side, which will not come.
        self.forwarder.retained.synchronize(Side.REMOTE)

    def check_again(self, epoch: int) -> None:  # noqa: ARG002  (a round of probes notices a reconnect)
        self._check_brokers()
        self.check_later()

    @every(_RETRY_S)
    def _repeat_requests(self) -> None:
        self._requests.repeat()

    @every(PERIOD_S)
    def _vouch(self) -> None:
        """Tell the motor owners in which period all messages to them were forwarded in time."""
        if not self.config.motor_owners:
            return
        gate, counters = self.forwarder.gate, self.forwarder.counters
        needs_no_bridge = gate is Gate.SHUT  # the two sides are one broker
        passes = self._same_broker.both_connected and (needs_no_bridge or bool(self.subscriptions[Side.REMOTE]))
        late, refused = counters[f"{Side.REMOTE.value}: {Drop.LATE.value}"], counters[f"{Side.LOCAL.value}: refused"]
        # Any change of these may mean a loss on the way in: late from the remote side, or refused by the local one.
        losses = gate, self.epoch, self._local_changes, refused, late, self.transport.counters["dropped"]
        self.publish(c.CONTROL_VOUCHED, self._vouching.check(passes, losses, self.clock()))

    @every(CHECK_S)
    def _check_owners(self) -> None:
        self._owners.check(self.clock())
        for owner, stop in self._passed_stops.give_up():
            self.log.error("an emergency stop is not confirmed by %s, which has withdrawn its own", owner)
            self._observers.tell(Observer.unconfirmed, owner, stop)

    @every(REPEAT_S)
    def _repeat_stops(self) -> None:
        for payload in self._passed_stops.repeat():
            self.transport.publish(self._stop_topic, payload, qos=QoS.DELIVERED, urgent=True)

    # -- the transports' threads

    def on_side_state(self, side: Side, state: State) -> None:
        if side is Side.LOCAL:
            self._owners.connected()
            self._local_changes += 1
        super().on_side_state(side, state)

    def receive_local(self, message: Message) -> None:
        if message.topic == self._same_broker.topic:
            self._on_probe(message)  # probes are never forwarded
            return
        if self._heartbeat is not None and message.topic == self._heartbeat.topic:
            if self._heartbeat.is_ours(message) and self.forwarder.gate is Gate.OPEN:
                # it was sent to the other side: one broker after all, or another program's of the same millisecond
                self.post_message(c.BRIDGE_PROBE, self._same_broker.send_again, newest_of="suspect")
            return
        if message.topic in self._owners.topics:
            self._owners.receive(message.topic)
            self._follow_owner(self._owners.topics[message.topic], message.payload)
        if message.topic == self._control_topic:
            self._follow_control(message.payload)
        if message.topic == self._stop_topic and not message.retain:  # the owners have it, except one that restarts now
            self._passed_stops.accept(named(message.payload), nameless=not is_named(message.payload))  # `named` adds it
        self._leftovers.note_local(message)
        for admitted in self._private.admit(message):
            self._react(Side.LOCAL, admitted, self.forwarder.receive(Side.LOCAL, admitted))

    def _follow_control(self, payload: bytes) -> None:
        """Note who has control, and the present key: the time stamp of a command with another key is not judged."""
        keys = None  # without a valid state: the stamp of every command is judged
        with suppress(PayloadError):
            state: ControlState = codec.decode(c.CONTROL_STATE, payload)
            keys = frozenset([state.key.encode()]) - {b""}  # key "": no client has control, so no stamp is judged
            self._observers.tell(Observer.control, state)
        self.forwarder.ages.keys = keys

    def _on_probe(self, message: Message) -> None:
        if self._same_broker.proves_same_broker(message):
            self.shut()
        elif self._same_broker.is_request(message):
            self.post_message(c.BRIDGE_PROBE, self._same_broker.answer_request, newest_of="request")

    def receive_remote(self, epoch: int, message: Message) -> None:
        topic = message.topic if self.names is None else self.names[message.topic].topic
        if epoch != self.epoch or self._private.stays(topic):  # epoch: it is of an earlier connection
            return
        if topic == self._stop_topic:
            if not self._has_passed(message):  # by the connection for stops alone
                self._receive_stop(message)
            return
        self._react(Side.REMOTE, message, self.forwarder.receive(Side.REMOTE, message))

    def _receive_stop(self, message: Message) -> None:
        """Name a stop before anything else, so that all who wait for its confirmation know it by one name."""
        message = msgspec.structs.replace(message, payload=named(message.payload))
        self._react(Side.REMOTE, message, self.forwarder.receive(Side.REMOTE, message))

    def pass_stop(self, side: Side, payload: bytes) -> Iterable[bytes]:
        return self._passed_stops.accept(payload) if side is Side.REMOTE else (payload,)

    def _follow_owner(self, owner: str, payload: bytes) -> None:
        with suppress(PayloadError):
            state = codec.decode(c.ESTOP_STATE, payload) if payload else None
            self._passed_stops.follow(owner, state)
            if state is not None:
                self._observers.tell(Observer.estop, owner, state)

    def _has_passed(self, message: Message) -> bool:
        """True if the stops' own connection has passed this stop on already. Otherwise remembers it."""
        return self._stops is not None and not self.forwarder.mirroring.on and self._stops.is_copy(message)

    def _pass_stop(self, message: Message) -> None:
        """Forward a stop of the stops' own connection.

        While mirroring is on, forward none. The bridge then sends the stops of the robot's own programs to the remote
        broker, and this connection, which is another client there, receives them again: the robot would get its own.
        """
        if not self.forwarder.mirroring.on:
            self._receive_stop(message)

    def _react(self, side: Side, message: Message, routed: Routed) -> None:
        """Tell the observers of a message, and handle a request to the bridge itself.

        Requests of the robot's programs count even while nothing is forwarded. The bridge does not receive what it
        forwards to the local side, so requests from the remote side are handled here, too.
        """
        channel = routed.subject.channel if routed.subject is not None else None
        is_local = side is Side.LOCAL
        if not is_local and isinstance(routed.outcome, Drop):
            self._observers.tell(Observer.refused, routed.outcome, channel, routed.by)
        if routed.outcome is Drop.STALE:
            self.refusals.stale("a command" if channel is None else channel.metric)
            return
        if isinstance(routed.outcome, Drop) and (routed.outcome in _IGNORED or not is_local):
            return  # a dropped message is a request only if it is the robot's own, and not dropped for one of _IGNORED
        if channel is None or codec.is_blank(message.payload):
            return
        if not message.retain and routed.outcome is not Drop.KNOWN:  # KNOWN: nothing new for observers
            # With a closed gate both sides may be one broker, and the message an operator's.
            by_robot = is_local and self.forwarder.gate is Gate.OPEN
            self._observers.tell(Observer.passed, channel, ROBOT if by_robot else routed.by, message.payload)
        self._requests.message(channel, message.payload)

    def on_value(self, subject: Subject, payload: bytes) -> None:
        if subject.channel is not None:
            self._requests.flag(subject.channel, payload)
