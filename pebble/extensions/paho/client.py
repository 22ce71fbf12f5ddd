"""A client like Pebble's own client of MQTT, by paho. It takes 1.5 times the processor time, and 5 MB more."""

import socket
import ssl
from collections.abc import Iterable
from typing import Any, cast

import paho.mqtt.client as paho
from paho.mqtt.enums import CallbackAPIVersion, MQTTErrorCode, MQTTProtocolVersion
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties
from paho.mqtt.reasoncodes import ReasonCode
from paho.mqtt.subscribeoptions import SubscribeOptions

from pebble.transports import hosts
from pebble.transports.hosts import dial
from pebble.transports.mqtt.client import SEND_BUFFER, Opening, begin_tls, is_hang_up
from pebble.transports.mqtt.packets import ANY_QOS, HEAD, MAX_PACKET, RETAIN, Accepted, Filter, Listener

_PIECE = 64 * 1024  # bytes that are read at once
_IN_FLIGHT = 65_535  # messages of QoS 1; their number is bounded by the connection


class _Paho(paho.Client):
    """A client of paho with limited queues and pings of our own: paho's keepalive notices a silence too late (T19)."""

    listener: Listener
    opening: Opening
    ahead = b""  # bytes that were taken out of the socket
    begin = 0  # of these, how many paho has read

    def _create_socket_connection(self) -> socket.socket:
        return dial(self.opening.address)  # paho would try all of the host's in one attempt

    def _ssl_wrap_socket(self, tcp_sock: socket.socket) -> ssl.SSLSocket:
        return begin_tls(tcp_sock, self.opening)  # paho waits for 2 s, whatever arrives

    def _sock_recv(self, bufsize: int) -> bytes:
        """Return bytes that `PahoClient.receive` took out of the socket, from which paho itself reads nothing."""
        if self.begin == len(self.ahead):
            raise BlockingIOError  # as an empty socket does, so that paho waits
        if self._too_long:  # discard what paho has collected of the packet that arrives, after its head
            del self._in_packet["packet"][HEAD:]
        data = self.ahead[self.begin : self.begin + bufsize]
        self.begin += len(data)
        return data

    @property
    def _too_long(self) -> bool:
        """True if the arriving packet is discarded, except its head."""
        return bool(self._in_packet["have_remaining"]) and self._in_packet["remaining_length"] > MAX_PACKET

    def _handle_publish(self) -> MQTTErrorCode:
        """Let paho handle a PUBLISH; if it is too long or not wanted, only acknowledge it."""
        packet, first = self._in_packet["packet"], self._in_packet["command"]
        topic_end = 2 + int.from_bytes(packet[:2])
        id_end = topic_end + 2 if first & ANY_QOS else topic_end  # with QoS 0 there is no message id
        if self._too_long:
            self.listener.on_too_long(bytes(packet[2:topic_end]), self._in_packet["remaining_length"])
        elif not (first & RETAIN and self._skips_retained(packet, topic_end, id_end)):
            return super()._handle_publish()
        if id_end == topic_end:
            return MQTTErrorCode.MQTT_ERR_SUCCESS
        return self._send_puback(int.from_bytes(packet[topic_end:id_end]))

    def _skips_retained(self, packet: bytearray, topic_end: int, payload_at: int) -> bool:
        """True if this retained PUBLISH is not wanted. Removals are wanted."""
        if self._protocol == MQTTProtocolVersion.MQTTv5 and payload_at < len(packet):
            payload_at += 1 + packet[payload_at]  # properties are before it, of which nobody needs 128 bytes
        return len(packet) > payload_at and self.listener.skips(bytes(packet[2:topic_end]))

    def _handle_on_message(self, message: paho.MQTTMessage) -> None:
        first = (ANY_QOS if message.qos else 0) | (RETAIN if message.retain else 0)
        self.listener.on_publication(message._topic, bytes(message.payload), first)

    def _handle_connack(self) -> MQTTErrorCode:
        if self._protocol != MQTTProtocolVersion.MQTTv5 and self._in_packet["packet"][1:2] == b"\1":
            self.listener.on_refused(1)  # paho would try an older version
            return MQTTErrorCode.MQTT_ERR_CONN_REFUSED
        return super()._handle_connack()

    def _handle_pingresp(self) -> MQTTErrorCode:
        self.listener.on_pong()
        return super()._handle_pingresp()


class PahoClient:
    """A client with the methods of `pebble.transports.mqtt.client.Client`."""

    def __init__(self, opening: Opening, listener: Listener, *, bridge: bool) -> None:
        client_id, settings, context, will, *_ = opening
        self.drained = True  # `receive` has emptied the socket
        self.hung_up = True  # so that a failed write counts as a hang-up: paho does not say why it failed
        self.failure: OSError | None = None  # why there is nothing more to read, if not because of a FIN
        self._settings, self._context, self._listener = settings, context, listener
        self._modern = settings.protocol == "5"
        protocol = MQTTProtocolVersion.MQTTv5 if self._modern else MQTTProtocolVersion.MQTTv311
        self._paho = client = _Paho(
            CallbackAPIVersion.VERSION2, client_id=client_id, protocol=protocol, reconnect_on_failure=False
        )
        client.listener, client.opening = listener, opening
        client.connect_timeout = hosts.CONNECT_TIMEOUT_S
        if not self._modern:
            client.max_inflight_messages_set(_IN_FLIGHT)  # on MQTT 5 a broker may allow only paho's default, 20
            if bridge:
                client.enable_bridge_mode()
        if settings.username is not None:
            client.username_pw_set(settings.username, settings.password)
        if context is not None:
            client.tls_set_context(context)
        if will is not None:
            client.will_set(will.topic, will.payload, int(will.qos), will.retain)
        client.on_socket_open = self._on_socket_open
        client.on_socket_register_write = lambda *_: None  # else paho writes by itself
        client.on_connect = self._on_connect
        client.on_disconnect = self._on_disconnect
        client.on_subscribe = self._on_subscribe
        client.on_unsubscribe = lambda _client, _data, mid, _reasons, _properties: listener.on_answer(mid, b"")
        client.on_publish = lambda _client, _data, mid, reason, _properties: listener.on_puback(mid, reason.value)

    def open(self) -> None:
        self._paho.connect(self._settings.host, self._settings.port, self._settings.keepalive_s)
        self.write()

    def close(self) -> None:
        if (sock := self.socket) is not None:
            sock.close()

    @property
    def socket(self) -> socket.socket | None:
        sock = cast("socket.socket | None", self._paho.socket())
        return None if sock is None or sock.fileno() < 0 else sock

    # -- reading

    @property
    def unread(self) -> int:
        return len(self._paho.ahead) - self._paho.begin

    def receive(self) -> int:
        """Take bytes out of the socket, for paho to read, and return their number; close it if the other side has."""
        sock, self.drained = self.socket, True
        if sock is None:
            return 0
        try:
            data, error = sock.recv(_PIECE), None
        except (BlockingIOError, ssl.SSLWantReadError, ssl.SSLWantWriteError):
            return 0
        except OSError as failure:
            data, error = b"", failure
        if not data:
            self.hung_up, self.failure = is_hang_up(error), error
            self.close()
        # With TLS the number of unpacked bytes does not tell whether the socket has more.
        self.drained = not data or (len(data) < _PIECE and self._context is None)
        self._paho.ahead, self._paho.begin = data, 0  # paho reads these bytes, from the first one on
        return len(data)

    owes = False  # paho acknowledges as it reads

    def read(self, most: int) -> int:
        for _ in range(most):
            if not self.unread or self._paho.loop_read(1) is not MQTTErrorCode.MQTT_ERR_SUCCESS:
                break
        self.write()
        return self.unread

    def acknowledge(self) -> None:
        """Do nothing: paho sends acknowledgements."""

    # -- writing

    @property
    def unwritten(self) -> int:
        return sum(packet["to_process"] for packet in self._paho._out_packet)

    @property
    def waiting(self) -> bool:
        return self._paho.want_write()

    def write(self) -> None:
        if self._paho.want_write():
            self._paho.loop_write()

    def publish(self, topic: str, payload: bytes, qos: int, *, retain: bool, expires_s: int | None) -> int:
        properties = None
        if self._modern and expires_s is not None:
            properties = Properties(PacketTypes.PUBLISH)  # type: ignore[no-untyped-call]
            properties.MessageExpiryInterval = expires_s
        sent = self._paho.publish(topic, payload, qos, retain, properties)
        self.write()
        return sent.mid if qos else 0

    def subscribe(self, filters: Iterable[Filter]) -> int:
        return self._request(self._paho.subscribe([self._topic(filter_) for filter_ in filters]))

    def unsubscribe(self, filters: Iterable[str]) -> int:
        return self._request(self._paho.unsubscribe(list(filters)))

    def _topic(self, filter_: Filter) -> Any:
        if not self._modern:
            return filter_.text, filter_.qos
        handling = SubscribeOptions.RETAIN_SEND_ON_SUBSCRIBE
        if not filter_.sends_retained:
            handling = SubscribeOptions.RETAIN_DO_NOT_SEND
        return filter_.text, SubscribeOptions(filter_.qos, filter_.no_local, filter_.as_published, handling)

    def _request(self, sent: tuple[MQTTErrorCode, int | None]) -> int:
        self.write()
        return sent[1] or 0  # 0: lost; no answer will have it

    def ping(self) -> None:
        self._paho._send_pingreq()
        self.write()

    def disconnect(self) -> None:
        self._paho.disconnect()
        self.write()

    # -- paho's callbacks

    def _on_socket_open(self, _client: Any, _data: Any, sock: Any) -> None:
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)

    def _on_connect(self, _client: Any, _data: Any, _flags: Any, reason: ReasonCode, properties: Any) -> None:
        if reason.is_failure:
            self._listener.on_refused(reason.value)
        else:
            accepted = Accepted(
                max_packet=getattr(properties, "MaximumPacketSize", None),
                max_qos=getattr(properties, "MaximumQoS", None),
                retain=getattr(properties, "RetainAvailable", None),
            )
            self._listener.on_accepted(accepted)

    def _on_disconnect(self, _client: Any, _data: Any, flags: Any, reason: ReasonCode, _properties: Any) -> None:
        if flags.is_disconnect_packet_from_server:
            self._listener.on_disconnect(reason.value)

    def _on_subscribe(self, _client: Any, _data: Any, mid: int, answers: list[ReasonCode], _properties: Any) -> None:
        self._listener.on_answer(mid, bytes(answer.value for answer in answers))
