"""What one client of the gate sends: bytes in; bytes for the broker, answers and drive commands out. Pure."""

import hmac
from typing import NamedTuple

from pebble.services.autonomy_manager.gate.packets import (
    Connect,
    Kind,
    PacketCutter,
    PacketError,
    VersionError,
    acknowledgement,
    connack,
    read_connect,
    read_id,
    read_publish,
    write_connect,
)
from pebble.services.autonomy_manager.gate.topics import Rule, TopicRules

BAD_LOGIN = 4  # CONNACK: bad user name or password


class Login(NamedTuple):
    """User and password of an MQTT connection; None: not given."""

    username: bytes | None = None
    password: bytes | None = None


class DriveCommand(NamedTuple):
    """A message on a drive topic, not yet parsed. ``repeated``: sent again after an outage (MQTT's DUP)."""

    topic: str
    payload: bytes
    repeated: bool


class Output:
    """What is to be done with received bytes. ``refusal`` is why the connection ends, after all else is done."""

    def __init__(self) -> None:
        self.upstream = bytearray()  # for the broker
        self.answers = bytearray()  # for the client
        self.drive: list[DriveCommand] = []  # in order
        self.refused_topics: list[str] = []
        self.refusal: str | None = None
        self.published = self.subscribed = False


class ClientFilter:
    """Lets a client log in with ``own``, logs it in at the broker with ``broker``, and takes out its drive commands.

    It acknowledges what it takes out, at every QoS: the broker never learns of these packets.
    """

    def __init__(self, rules: TopicRules, own: Login, broker: Login) -> None:
        self._rules, self._own, self._broker = rules, own, broker
        self._cutter = PacketCutter()
        self._unreleased: set[int] = set()  # ids of taken QoS 2 packets, until their PUBREL
        self._begun = False
        self.connected = False  # the broker may be given what follows

    def feed(self, data: bytes) -> Output:
        """Handle received bytes. Nothing may be fed after a refusal."""
        output = Output()
        try:
            if not self._begun and data and data[0] != Kind.CONNECT << 4:
                raise PacketError("the first packet is no CONNECT")
            self._begun = self._begun or bool(data)
            for packet in self._cutter.feed(data):
                if not self.connected:
                    self._connect(packet, output)
                elif packet[0] >> 4 == Kind.CONNECT:
                    raise PacketError("a second CONNECT")
                elif packet[0] >> 4 == Kind.PUBLISH:
                    output.published = True
                    self._publish(packet, output)
                elif packet[0] >> 4 == Kind.PUBREL:
                    self._release(packet, output)
                else:
                    output.subscribed = output.subscribed or packet[0] >> 4 == Kind.SUBSCRIBE
                    output.upstream += packet
        except _LoginError:
            output.answers += connack(BAD_LOGIN)
            output.refusal = "a wrong user or password: use those of the config it was given"
        except VersionError as error:
            output.answers += error.answer
            output.refusal = f"{error}: only MQTT 3.1.1 can be signed"
        except PacketError as error:
            output.refusal = str(error)
        return output

    def _connect(self, packet: bytes, output: Output) -> None:
        connect = read_connect(packet)
        given = Login(connect.username, connect.password)
        if not all(hmac.compare_digest(a or b"", b or b"") for a, b in zip(given, self._own, strict=True)):
            raise _LoginError
        self.connected = True
        connect = connect._replace(username=self._broker.username, password=self._broker.password)
        output.upstream += write_connect(self._without_driving_will(connect))

    def _without_driving_will(self, connect: Connect) -> Connect:
        """A will that drives is not needed: the gate itself stops the wheels when the connection ends."""
        if connect.will is None or self._rule(connect.will[0]) is Rule.FORWARD:
            return connect
        return connect._replace(will=None)

    def _publish(self, packet: bytes, output: Output) -> None:
        publish = read_publish(packet)
        rule = self._rule(publish.topic)
        if rule is Rule.FORWARD:
            output.upstream += packet
            return
        if rule is Rule.REFUSE:
            output.refused_topics.append(publish.topic.decode())
        elif publish.qos < 2 or publish.packet_id not in self._unreleased:
            output.drive.append(DriveCommand(publish.topic.decode(), publish.payload, publish.dup))
        if publish.qos == 1:
            output.answers += acknowledgement(Kind.PUBACK, publish.packet_id)
        elif publish.qos == 2:
            self._unreleased.add(publish.packet_id)
            output.answers += acknowledgement(Kind.PUBREC, publish.packet_id)

    def _release(self, packet: bytes, output: Output) -> None:
        packet_id = read_id(packet)
        if packet_id in self._unreleased:
            self._unreleased.remove(packet_id)
            output.answers += acknowledgement(Kind.PUBCOMP, packet_id)
        else:
            output.upstream += packet

    def _rule(self, topic: bytes) -> Rule:
        try:
            return self._rules.rule(topic.decode())
        except UnicodeDecodeError:
            return Rule.FORWARD  # the broker closes the connection


class _LoginError(Exception):
    """A CONNECT with another user or password."""
