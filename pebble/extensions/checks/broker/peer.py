"""A trial of a broker: clients on one thread that show its behaviour packet by packet.

The transports hide what a broker lacks; this module shows it.
"""

from __future__ import annotations

import secrets
import socket
import struct
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from typing import NamedTuple

from pebble.check_result import CheckResult, State
from pebble.errors import TransportError
from pebble.transports.base import Message
from pebble.transports.credentials import Credentials
from pebble.transports.hosts import Address
from pebble.transports.mqtt import client_ids, packets, reasons
from pebble.transports.mqtt.client import Client, Opening
from pebble.transports.mqtt.ending import WANTS_TLS, alert, unreached
from pebble.transports.settings import MqttSettings

ANSWER_S = 3.0  # within which a broker answers, and four round trips
_MORE_PATIENCE = 4  # times as long may a busy broker take
_QUIET_S = 0.3  # of silence, and four round trips, after which nothing more comes
_STEP_S = 0.001  # between two looks at what has come
_KEEPALIVE_S = 60
_AT_ONCE = 1000  # packets
_MOST, _MOST_BYTES = 5_000, 20_000_000  # that one connection reads; a probe sends a thousand messages
_ANSWER_BYTES = 1000  # for which an answer counts, so that an end comes to 20,000 of them
_HANGS_UP = ("it hangs up", f"it hangs up; {WANTS_TLS}")
_BAD = (State.WARN, State.FAILED)
_RESET = struct.pack("ii", 1, 0)  # SO_LINGER that turns close() into a reset

NAME = "pebble-doctor-of-a-broker"  # as long as the names of a robot's programs


class RefusedError(TransportError):
    """An error: the broker refuses this client. ``code``: that of its CONNACK, if it sent one."""

    def __init__(self, text: str, code: int | None = None) -> None:
        super().__init__(text)
        self.code = code


class Received(NamedTuple):
    """A received message. ``topic`` is relative to the probe's base topic; ``at`` is when it was read (monotonic)."""

    topic: str
    payload: bytes
    retain: bool
    at: float


class Peer(packets.Listener):
    """A connection, which is served in :meth:`BrokerTrial.wait`.

    Topics are relative to ``base``; if ``base`` is empty they are complete.
    """

    def __init__(self, trial: BrokerTrial, base: str, opening: Opening, *, bridge: bool) -> None:
        """Start to connect. ``bridge``: in the bridge mode of MQTT 3.1.1."""
        self.received: list[Received] = []
        self.acks: dict[int, int] = {}  # acknowledged publications, by message id: the code of MQTT 5
        self.granted: dict[int, bytes] = {}  # answered subscriptions, by message id: a code for each filter
        self.pongs: list[int] = []  # how many messages had been received at each answer to a ping
        self.code: int | None = None  # of CONNACK
        self.problem = ""
        self._bytes = 0  # received in messages; each answer counts as _ANSWER_BYTES
        self._trial, self.base = trial, base
        self._client = Client(opening, self, bridge=bridge)
        self._client.open()

    # -- what it does

    def subscribe(self, *filters: str, qos: int = 1, options: bool = False) -> bytes:
        """Subscribe; return the broker's code for each filter, or nothing if no answer comes.

        ``options``: use the subscription options of MQTT 5 (noLocal, retain-as-published).
        """
        names = map(self._whole, filters)
        wanted = [packets.Filter(name, qos, no_local=options, as_published=options) for name in names]
        mid = self._client.subscribe(wanted)
        self._trial.wait(lambda: mid in self.granted or self.closed)
        return self.granted.get(mid, b"")

    def publish(self, topic: str, payload: bytes = b"1", *, qos: int = 0, retain: bool = False) -> int:
        """Publish; return the message's number, as used in `acks`, or 0 with QoS 0."""
        if retain:
            self._trial.left[self._whole(topic)] = None
        return self._client.publish(self._whole(topic), payload, qos, retain=retain, expires_s=None)

    def _whole(self, topic: str) -> str:
        return f"{self.base}/{topic}" if self.base else topic

    def ping(self) -> bool:
        """Ping the broker; return False if no answer came in time."""
        before = len(self.pongs)
        self.send_ping()
        return self._trial.wait(lambda: len(self.pongs) > before or self.closed) and not self.closed

    def send_ping(self) -> None:
        self._client.ping()

    def leave(self) -> None:
        """Disconnect in order: the broker does not publish the will."""
        self._client.disconnect()
        self._client.close()

    def cut(self) -> None:
        """Reset the connection: the broker publishes the will."""
        if self.sock is not None:
            self.sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _RESET)
        self._client.close()

    def acknowledge_late(self) -> None:
        """Let the kernel delay its TCP acknowledgements, as it does for a program that only receives."""
        if self.sock is not None and hasattr(socket, "TCP_QUICKACK"):
            self.sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_QUICKACK, 0)

    # -- what it saw

    @property
    def closed(self) -> bool:
        return self._client.socket is None

    @property
    def failure(self) -> str:
        """Return in words why TLS has ended the connection; empty if TLS has not."""
        failure = self._client.failure
        return unreached(failure, tls=True) if failure is not None and alert(failure) else ""

    @property
    def sock(self) -> socket.socket | None:
        return self._client.socket

    def payloads(self, topic: str | None = None) -> list[bytes]:
        return [message.payload for message in self.received if topic in (None, message.topic)]

    def topics(self) -> set[str]:
        return {message.topic for message in self.received}

    # -- inside

    def pump(self) -> None:
        """Read what has arrived, and write what is waiting."""
        client = self._client
        try:
            while len(self.received) < _MOST and client.receive():  # takes bytes out of the socket
                while client.read(_AT_ONCE) and self._bytes < _MOST_BYTES:  # handles the packets in them
                    pass
                if self._bytes >= _MOST_BYTES:
                    self.problem = "it sends without end"
                    client.close()
        except packets.MalformedError as error:
            self.problem = f"it sends what is no MQTT: {error}"
            client.close()
        if client.owes:
            client.acknowledge()
        if client.waiting:
            client.write()

    def on_accepted(self, accepted: packets.Accepted) -> None:
        del accepted
        self.code = 0

    def on_refused(self, code: int) -> None:
        self.code = code
        self.problem = reasons.connection_refused(code)

    def on_publication(self, topic: bytes, payload: bytes, first: int) -> None:
        self._bytes += len(topic) + len(payload)
        below = topic.decode(errors="replace").removeprefix(f"{self.base}/")
        self.received.append(Received(below, payload, bool(first & packets.RETAIN), time.monotonic()))

    def on_puback(self, mid: int, code: int) -> None:
        self._bytes += _ANSWER_BYTES
        self.acks[mid] = code

    def on_answer(self, mid: int, codes: bytes) -> None:
        self._bytes += _ANSWER_BYTES
        self.granted[mid] = codes

    def on_pong(self) -> None:
        self._bytes += _ANSWER_BYTES
        self.pongs.append(len(self.received))

    def on_disconnect(self, code: int) -> None:
        self.problem = reasons.words(code)

    def on_too_long(self, topic: bytes, length: int) -> None:
        self.on_publication(topic, b"", 0)
        self.problem = f"a message of {length} bytes"

    def skips(self, topic: bytes) -> bool:
        del topic
        return False


class BrokerTrial:
    """Peers at one broker, and the retained messages that they left there.

    ``address``: the host's address that accepted the login. Each probe has topics below ``{below}/{random digits}``;
    :meth:`close` removes their retained messages.
    """

    def __init__(
        self,
        settings: MqttSettings,
        address: Address,
        below: str,
        restart: Callable[[], bool] | None = None,
        patience_s: float = ANSWER_S,
    ) -> None:
        self.settings = settings
        self.restart = restart  # has a person restart the broker; returns False if it was not
        self.below = below
        self.base = ""  # the base topic of the present probe
        self.round_trip_s, self.patience_s = 0.0, patience_s
        self.late = False  # an answer of the present probe came late
        self.qos, self.retains, self.wildcards = 1, True, True  # what the broker supports; the first probes find out
        self._address = address
        self._peers: list[Peer] = []
        self.left: dict[str, None] = {}  # topics with a retained message of ours, in the order of publishing
        self._credentials = Credentials(settings)

    def judge(self, test: Callable[[BrokerTrial], CheckResult]) -> CheckResult:
        """Return the result of ``test``. If it is bad and an answer was late, test a second time."""
        self.late = False
        result = test(self)
        if self.late and result.state in _BAD:
            result = test(self)  # `late` stays set: a good result of this second test is qualified as well
        if not self.late or result.state in _BAD:
            return result
        return replace(result, text=f"{result.text}; an answer was late, the broker or this machine is busy")

    def begin(self) -> None:
        """Disconnect the peers of the last probe, and choose new topics for the next."""
        for peer in self._peers:
            peer.leave()
        self._peers, self.base = [], f"{self.below}/{secrets.token_hex(8)}"

    def peer(self, *, protocol: str = "3.1.1", bridge: bool = False, will: Message | None = None) -> Peer:
        """Connect a client, or raise RefusedError; the topic of ``will`` is relative to the probe's base topic."""
        password = self._credentials.password()
        settings = replace(self.settings, protocol=protocol, keepalive_s=_KEEPALIVE_S, password=password)
        name = self.settings.client_id or client_ids.unique(NAME)
        if will is not None:
            will = Message(f"{self.base}/{will.topic}", will.payload, will.qos, retain=will.retain)
            if will.retain:
                self.left[will.topic] = None
        opening = Opening(name, settings, self._credentials.context(), will, self._address, self.patience_s)
        try:
            peer = Peer(self, self.base, opening, bridge=bridge)
        except OSError as error:
            raise RefusedError(unreached(error, tls=settings.tls is not None)) from None
        self._peers.append(peer)
        self.wait(lambda: peer.code is not None or peer.closed, _MORE_PATIENCE * self.answer_s)
        if peer.code != 0:
            silence = _HANGS_UP[settings.tls is None] if peer.closed else "it does not answer"
            why = peer.problem or peer.failure or silence
            peer.leave()
            raise RefusedError(why, peer.code)
        return peer

    @property
    def answer_s(self) -> float:
        """Return how long to wait for an answer."""
        return self.patience_s + 4 * self.round_trip_s

    def wait(self, condition: Callable[[], object], seconds: float | None = None) -> bool:
        """Serve all peers until ``condition`` holds; return False if it does not in time.

        ``seconds``: the longest wait. None: the usual time of a broker's answer. Then, in case the broker is busy, a
        ping is sent, and the wait goes on until it is answered, but at most several times as long.
        """
        if self._serve(condition, self.answer_s if seconds is None else seconds):
            return True
        if seconds is not None:
            return False
        asked = {peer: len(peer.pongs) for peer in self._peers if peer.code == 0 and not peer.closed}
        for peer in asked:
            peer.send_ping()
        self._serve(
            lambda: condition() or all(peer.closed or len(peer.pongs) > before for peer, before in asked.items()),
            _MORE_PATIENCE * self.answer_s,
        )
        came = self._serve(condition, _QUIET_S)  # it may come after the pongs, but not after so much silence
        self.late |= came
        return came

    def _serve(self, condition: Callable[[], object], seconds: float) -> bool:
        end = time.monotonic() + seconds
        while True:
            for peer in self._peers:
                peer.pump()
            if condition():
                return True
            if time.monotonic() >= end or all(peer.closed for peer in self._peers):
                return False
            time.sleep(_STEP_S)

    def wait_quiet(self, *peers: Peer) -> None:
        """Serve all peers until no more messages arrive."""
        quiet_s, end = _QUIET_S + 4 * self.round_trip_s, time.monotonic() + self.answer_s

        def count() -> int:
            return sum(len(peer.received) for peer in peers)

        while time.monotonic() < end:
            before = count()
            if not self.wait(lambda: count() > before, quiet_s):  # noqa: B023
                return

    def close(self) -> None:
        """Remove all retained messages of this trial; those that the broker keeps stay in ``left``."""
        self.begin()  # disconnects the peers of the last probe
        if not self.left:
            return
        self.base = ""  # topics in ``left`` are complete
        with suppress(TransportError):
            peer = self.peer()
            numbers = {peer.publish(topic, b"", qos=self.qos, retain=True) for topic in list(self.left)}
            # With QoS 0 nothing is acknowledged, but a ping is answered after what was sent before it.
            is_done = self.wait(lambda: all(number in peer.acks for number in numbers)) if self.qos else peer.ping()
            if is_done:
                self.left = {}
            peer.leave()
