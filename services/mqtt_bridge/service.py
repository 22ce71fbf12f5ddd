"""The bridge as a process: two transports, a routing table, a heartbeat, and the actions operators may ask for."""

from __future__ import annotations

import time
from functools import partial

from pebble import codec
from pebble.contract import BRIDGE_PROBE, INCOMING, ONLINE, OUTGOING, REMOTE_MIRROR, Channel, Kind
from pebble.errors import PayloadError
from pebble.forwarding.forwarder import SETTLE_S, Forwarder, Gate, barrier
from pebble.forwarding.routing import Drop, Forward, Side
from pebble.forwarding.subjects import Subject, Subjects
from pebble.launched import Notifier, Want, wanted_before
from pebble.links import remote_transport
from pebble.payloads import MediaRequest
from pebble.service import Service, every
from pebble.services.mqtt_bridge.actions import ACTIONS, Actions
from pebble.services.mqtt_bridge.heartbeat import Heartbeat
from pebble.services.mqtt_bridge.media import MEDIA, Media
from pebble.services.mqtt_bridge.one_broker import OneBroker
from pebble.services.mqtt_bridge.private_topics import PrivateTopics
from pebble.services.mqtt_bridge.routing import TABLE_A1
from pebble.transports import Message, State, Subscription

#: After the barrier, for brokers that hand messages from connection to connection at their leisure.
_VERDICT_S = 0.1
_PROBE_PERIOD_S = 1.0
_RETRY_S = 1.0
_REQUESTS = tuple(row.request for row in MEDIA)
_MEDIA_FLAGS = tuple(row.flag for row in MEDIA)


class MqttBridge(Service):
    """Forwards by Table A.1, once it is sure that its two sides are not one broker.

    Messages are forwarded on the transports' receiving threads (pebble.forwarding.forwarder says why); everything else
    happens on the service's own thread, so a burst of messages delays neither the heartbeat nor a verdict.
    """

    name = "mqtt_bridge"
    publishes = (ONLINE, BRIDGE_PROBE)
    client_name = "local-bridge"
    as_published = True

    @classmethod
    def handles(cls) -> tuple[Channel, ...]:
        media = (channel for row in MEDIA for channel in (row.flag, row.request))
        return (REMOTE_MIRROR, *media, *(row.channel for row in ACTIONS))

    def start(self) -> None:
        section = self.config.services.mqtt_bridge
        self._subjects = Subjects(self.config)
        self._private = PrivateTopics(self.config.base)
        self._actions = Actions(section)
        self._media = Media(self.config.on_demand_programs(), wanted_before())
        self._notifier = Notifier()
        self._told: dict[str, Want] = {}  # as the launcher knows it
        self._heartbeat = Heartbeat(self.addresses[ONLINE]) if section.heartbeat.enabled else None
        self._one_broker = OneBroker(self.config.base)
        remote_kind = "mqtt" if section.remote is None else section.remote.kind
        self._may_be_one = self.config.transport.kind == remote_kind
        self._probed_at = float("-inf")
        self._round = 0  # of finding out whether both sides are one broker
        self._given_away = -1  # the round in which they turned out to be
        self._remote_epoch = 0
        self._local_subscriptions: list[Subscription] = []
        self._remote_subscriptions: list[Subscription] = []
        will = self._heartbeat.will(_now_ms()) if self._heartbeat is not None else None
        self._remote = remote_transport(self.config, "remote-bridge", will=will)
        self._forwarder = Forwarder(
            self._subjects,
            TABLE_A1,
            {Side.LOCAL: self.transport, Side.REMOTE: self._remote},
            winner=Side.REMOTE,
            agreed=self._on_agreed,
        )
        self.transport.on_state(partial(self._on_link, Side.LOCAL))
        self._remote.on_state(partial(self._on_link, Side.REMOTE))
        self._remote.open(timeout=0.0)
        if self._heartbeat is not None:
            self.timers.add(time.monotonic(), self._beat, period=section.heartbeat.interval_seconds)
        self.post(self._listen_locally)

    def stop(self) -> None:
        if hasattr(self, "_remote"):
            self.log.info("forwarded and dropped: %s", self._forwarder.counters.snapshot())
            self._remote.close()

    # -- the service's thread

    def _beat(self) -> None:
        if self._heartbeat is not None:
            self._heartbeat.beat(self._remote, _now_ms())

    def _listen_locally(self) -> None:
        self._local_subscriptions = [
            self.transport.subscribe(filter_, self._on_local, echo=False, direct=True)
            for filter_ in self._subjects.filters(INCOMING, OUTGOING)
        ]

    def _joined(self, side: Side, epoch: int) -> None:
        """A side is connected (again)."""
        if side is Side.REMOTE:
            self._beat()
        else:
            barrier(self.transport, self._one_broker.topic)
            self._forwarder.subscribed(Side.LOCAL)
            self._settle_later(Side.LOCAL)
        if self._forwarder.gate is not Gate.OPEN:
            self._find_out()
        elif side is Side.REMOTE and epoch == self._remote_epoch:
            self._probe()
            self._listen_remotely()
        else:
            self._probe()

    def _left(self, side: Side) -> None:
        if side is Side.REMOTE:
            self._stop_listening_remotely()

    def _settle_later(self, side: Side) -> None:
        epoch = self._remote_epoch

        def settle() -> None:
            if side is Side.LOCAL or epoch == self._remote_epoch:
                self._forwarder.settle(side)

        self.call_at(time.monotonic() + SETTLE_S, settle)

    def _listen_remotely(self) -> None:
        """Anew for each connection, once the transport has sent what changed while it was away: then what the remote
        side has kept is older than nothing of ours."""
        self._stop_listening_remotely()
        receive = partial(self._on_remote, self._remote_epoch)
        self._remote_subscriptions = [
            self._remote.subscribe(filter_, receive, echo=False, direct=True)
            for filter_ in self._subjects.filters(INCOMING)
        ]
        self._forwarder.subscribed(Side.REMOTE)
        self._settle_later(Side.REMOTE)

    def _stop_listening_remotely(self) -> None:
        subscriptions, self._remote_subscriptions = self._remote_subscriptions, []
        _close_all(subscriptions)

    # -- one broker or two

    def _probe(self) -> bool:
        self._probed_at = time.monotonic()
        return self._one_broker.probe(self._remote, _now_ms())

    def _find_out(self) -> None:
        if not self._may_be_one:
            self._open()
        if self._forwarder.gate is Gate.OPEN or not self._both_connected():
            return
        self._round += 1
        if self._probe() and self._one_broker.wait(self._remote, self._subjects.filters(INCOMING)[0], self.transport):
            self.call_at(time.monotonic() + _VERDICT_S, partial(self._decide, self._round))

    def _decide(self, round_: int) -> None:
        """Nothing came back: two brokers. A connection that was lost meanwhile brings a new round."""
        if round_ == self._round != self._given_away and self._both_connected():
            self._open()

    def _both_connected(self) -> bool:
        return self.transport.state is State.CONNECTED and self._remote.state is State.CONNECTED

    def _open(self) -> None:
        if self._remote.state is not State.CONNECTED or self._forwarder.gate is Gate.OPEN:
            return
        was_shut = self._forwarder.gate is Gate.SHUT
        self._forwarder.open()
        if was_shut:  # what was said meanwhile went nowhere: ask for the kept copies again
            _close_all(self._local_subscriptions)
            self._listen_locally()
        self._listen_remotely()
        self.log.info("forwarding between the robot and its remote side")

    def _suspect(self) -> None:
        """A heartbeat like ours came from the local side: ours, or one of the same millisecond?"""
        if time.monotonic() - self._probed_at >= _PROBE_PERIOD_S:
            self._probe()

    def _stand_down(self) -> None:
        self._forwarder.shut()  # again: it may just have been opened
        self._stop_listening_remotely()
        self.log.info("the local and the remote side are one broker: nothing is mirrored")
        self._forwarder.settle(Side.REMOTE)  # kept flags have waited for copies that it will not send

    def _run_action(self, channel: Channel) -> None:
        self.counters.add("actions" if self._actions.request(channel) else "actions_refused")

    def _allow_media(self, flag: Channel, allowed: bool) -> None:
        self._media.allow(flag, allowed)
        self._say_wants()

    def _request_media(self, channel: Channel, request: MediaRequest) -> None:
        self._media.request(channel, request)
        self._say_wants()

    @every(_RETRY_S)
    def _say_wants(self) -> None:
        """Tell the launcher what has changed; it starts and stops the programs, and we wait for nobody."""
        for program, want in self._media.wants().items():
            if self._told.get(program) != want and self._notifier.want(program, want):
                self._told[program] = want

    # -- the transports' threads

    def _on_link(self, side: Side, state: State) -> None:
        self._forwarder.watch(side, state)
        if state is State.CONNECTED:
            self.post(partial(self._joined, side, self._remote_epoch))
            return
        if side is Side.REMOTE:
            self._remote_epoch += 1
        self.post(partial(self._left, side))

    def _on_local(self, message: Message) -> None:
        if self._one_broker.is_probe(message):
            self._on_probe(message)
            return
        if self._heartbeat is not None and message.topic == self._heartbeat.topic:
            if self._heartbeat.is_ours(message) and self._forwarder.gate is Gate.OPEN:
                self.post(self._suspect, newest_of="suspect")
            return
        for admitted in self._private.admit(message):
            self._follow_up(Side.LOCAL, admitted, self._forwarder.receive(Side.LOCAL, admitted))

    def _on_probe(self, message: Message) -> None:
        if self._one_broker.gives_away(message):
            self._given_away = self._round
            if self._forwarder.gate is not Gate.SHUT:
                self._forwarder.shut()
                self.post(self._stand_down)

    def _on_remote(self, epoch: int, message: Message) -> None:
        if epoch != self._remote_epoch or self._private.is_known(message.topic):
            return
        self._follow_up(Side.REMOTE, message, self._forwarder.receive(Side.REMOTE, message))

    def _follow_up(self, side: Side, message: Message, result: Forward | Drop) -> None:
        """Do what is asked of ourselves, on the service's thread, whether or not there was anybody to forward it to.

        What we forward to the local side never comes back to us, so it is done right now.
        """
        subject = self._subjects[message.topic]
        channel = subject.channel if subject is not None else None
        local, action = side is Side.LOCAL, channel is not None and channel.kind is Kind.ACTION
        if result is Drop.STALE and not (local and channel and action and self._actions.accepts_kept(channel)):
            self._refuse_stale(subject)
        elif channel is None or result is Drop.ECHO or not (local or isinstance(result, Forward)):
            return
        elif _is_one_of(_REQUESTS, channel):
            self._hear_request(channel, message.payload)
        elif action and self._switch(channel, message.payload):
            self.post(partial(self._run_action, channel), newest_of=channel.metric)

    def _hear_request(self, channel: Channel, payload: bytes) -> None:
        try:
            request: MediaRequest = codec.decode(channel, payload)
        except PayloadError as error:
            self._refuse(channel, error)
        else:
            self.post(partial(self._request_media, channel, request), newest_of=channel.metric)

    def _refuse_stale(self, subject: Subject | None) -> None:
        what = "a command" if subject is None or subject.channel is None else subject.channel.metric
        self.counters.add("stale")
        self._quiet_log.warning(f"{what} kept", "refused a kept copy of %s", what)

    def _on_agreed(self, subject: Subject, payload: bytes) -> None:
        channel = subject.channel
        if channel is REMOTE_MIRROR:
            self._forwarder.mirroring = self._switch(REMOTE_MIRROR, payload)
        elif channel is not None and _is_one_of(_MEDIA_FLAGS, channel):
            self.post(partial(self._allow_media, channel, self._switch(channel, payload)), newest_of=channel.metric)

    def _switch(self, channel: Channel, payload: bytes) -> bool:
        """What a boolean control says; nothing (a removed flag) and nonsense are false."""
        try:
            return bool(payload) and bool(codec.decode(channel, payload))
        except PayloadError as error:
            self._refuse(channel, error)
            return False

    def _refuse(self, channel: Channel, error: PayloadError) -> None:
        self.counters.add("refused")
        self._quiet_log.warning(channel.metric, "refused a message: %s", error)


def _is_one_of(channels: tuple[Channel, ...], channel: Channel) -> bool:
    return any(channel is one for one in channels)  # comparing all they say takes longer


def _close_all(subscriptions: list[Subscription]) -> None:
    for subscription in subscriptions:
        subscription.close()


def _now_ms() -> int:
    return time.time_ns() // 1_000_000
