"""Foxglove's WebSocket server: its channels, their subscribers, and the last message of each."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from pebble.errors import PebbleError
from pebble.extensions.recordings.exports.foxglove_messages import MOST_CHANNELS, Schemas
from pebble.transports.socket_holders import port_holder

if TYPE_CHECKING:
    import foxglove
    from foxglove.websocket import ChannelView, Client, WebSocketServer

#: Messages that wait for one client before the SDK drops the oldest, uncounted, and how large each may be.
BACKLOG, MAX_BYTES = 128, 1 << 20
#: Of one remembered message, and of all together.
MAX_REMEMBERED, MAX_REMEMBERED_BYTES = 64 << 10, 32 << 20
_PAUSE_EVERY, _PAUSE_S = 16, 0.002  # after so many new channels it waits so long
_HOW: Final = 'pip install "pebble-robot[foxglove]"'


class ChannelSpec(NamedTuple):
    """A channel's description, by which Foxglove decodes it."""

    topic: str
    encoding: str  # of its messages: json or protobuf
    schema_name: str
    schema_encoding: str  # jsonschema or protobuf
    schema: bytes  # empty: any JSON


def protobuf_spec(topic: str, message: Any, schemas: Schemas) -> ChannelSpec:
    """Return the description of a channel for Protobuf messages of this kind."""
    return ChannelSpec(topic, "protobuf", message.DESCRIPTOR.full_name, "protobuf", schemas.descriptors(message))


class _Remembered(NamedTuple):
    data: bytes
    log_ns: int


class Server:
    """A server for clients that only watch. Any thread may publish; one thread declares channels.

    ``on_change(topic, subscribed)`` runs on a thread of the SDK when a client subscribes, unsubscribes or leaves.
    """

    def __init__(self, name: str, on_change: Callable[[str, bool], None]) -> None:
        """Store the settings. Raises PebbleError if the SDK is not installed."""
        self.dropped = 0  # too large, or of a channel too many
        self.published = 0
        self._name, self._on_change = name, on_change
        self._sdk = _sdk()
        self._context = self._sdk.Context()
        self._server: WebSocketServer | None = None
        self._channels: dict[str, foxglove.Channel] = {}  # by topic
        self._lock = threading.Lock()  # guards what follows
        self._subscribers: dict[str, set[int]] = {}  # by topic: ids of clients
        self._remembered: dict[str, _Remembered] = {}  # by topic: the last message, for later subscribers
        self._remembered_bytes = 0

    def start(self, host: str, port: int) -> str:
        """Listen, and return the address. Raises PebbleError."""
        try:
            self._server = self._sdk.start_server(
                name=self._name,
                host=host,
                port=port,
                capabilities=[],  # looking only: no client may publish, call or set anything
                server_listener=self,
                context=self._context,
                message_backlog_size=BACKLOG,
            )
        except RuntimeError as error:
            why = str(error).removeprefix("FoxgloveError: Failed to bind port: ").partition(" (os error")[0]
            raise PebbleError(
                f"cannot listen on {host} port {port}: {why}{port_holder(port)}; choose another with --port"
            ) from None
        shown = f"[{host}]" if ":" in host else host
        return f"ws://{shown}:{self._server.port}"

    def stop(self) -> None:
        if self._server is not None:
            self._server.stop()

    def declared(self, topic: str) -> bool:
        return topic in self._channels

    def declare(self, spec: ChannelSpec) -> None:
        """Advertise a channel, once and for ever.

        Beyond the limit of channels it is not advertised, and its messages are dropped.
        """
        if spec.topic in self._channels or len(self._channels) >= MOST_CHANNELS:
            return
        schema = self._sdk.Schema(name=spec.schema_name, encoding=spec.schema_encoding, data=spec.schema)
        self._channels[spec.topic] = self._sdk.Channel(
            spec.topic, schema=schema, message_encoding=spec.encoding, context=self._context
        )
        if len(self._channels) % _PAUSE_EVERY == 0:
            time.sleep(_PAUSE_S)  # the SDK ends a client for whom 128 new channels wait

    def subscribed(self, topic: str) -> bool:
        """True if any client has subscribed to this channel."""
        with self._lock:
            return bool(self._subscribers.get(topic))

    def publish(self, topic: str, data: bytes, log_ns: int, *, remember: bool = False) -> None:
        """Publish on a declared channel.

        ``remember``: send it to clients that subscribe later, too.
        """
        channel = self._channels.get(topic)
        with self._lock:
            if channel is None or len(data) > MAX_BYTES:
                self.dropped += 1
                return
            self.published += 1
            if remember or topic in self._remembered:  # later clients must not be sent an older message than this one
                self._remember(topic, _Remembered(data, log_ns))
        channel.log(data, log_time=log_ns)

    def report(self, text: str) -> None:
        """Show a problem to Foxglove's users."""
        if self._server is not None:
            self._server.publish_status(text, self._sdk.StatusLevel.Warning)

    def _remember(self, topic: str, message: _Remembered) -> None:
        old = self._remembered.pop(topic, None)
        self._remembered_bytes -= 0 if old is None else len(old.data)
        size = len(message.data)
        if size <= MAX_REMEMBERED and self._remembered_bytes + size <= MAX_REMEMBERED_BYTES:
            self._remembered[topic] = message
            self._remembered_bytes += size

    # -- threads of the SDK

    def on_subscribe(self, client: Client, channel: ChannelView) -> None:
        """Send a client the remembered message of a channel."""
        topic = channel.topic
        with self._lock:
            self._subscribers.setdefault(topic, set()).add(client.id)
            remembered = self._remembered.get(topic)
        declared = self._channels.get(topic)
        if remembered is not None and declared is not None:
            declared.log(remembered.data, log_time=remembered.log_ns, sink_id=client.id)
        self._on_change(topic, True)

    def on_unsubscribe(self, client: Client, channel: ChannelView) -> None:
        """Note that a client has unsubscribed or left."""
        with self._lock:
            self._subscribers.get(channel.topic, set()).discard(client.id)
        self._on_change(channel.topic, False)


def _sdk() -> Any:
    try:
        import foxglove
        import foxglove.websocket
    except ImportError as error:
        raise PebbleError(f"the live connection to Foxglove needs its SDK: {_HOW} ({error})") from None
    return foxglove
