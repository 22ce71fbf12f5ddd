"""Plays an operator's voice."""

import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any

from pebble.contract import AUDIO_STREAM, MEDIA_REPORT
from pebble.contract.names import with_name
from pebble.contract.payloads import MediaReport
from pebble.errors import DeviceError
from pebble.media.jitter import JitterBuffer
from pebble.media.rate_meter import RateMeter
from pebble.runtime.connections import remote_transport
from pebble.runtime.service import Service, every
from pebble.services.audio_receiver.player import Player
from pebble.transports import Message, QoS, State

_IDLE_S = 0.5  # between two checks whether it has been silent for long
_END_S = 1.5
_WAITING_PACKETS = 48  # that wait to be played


class PlaybackThread:
    """The thread between the network and the playing program: a jitter buffer, and writes that may block.

    ``put`` is for any thread; everything else runs on its own. ``on_end`` is called there, however it ends.
    """

    def __init__(
        self,
        buffer: JitterBuffer,
        make_player: Callable[[threading.Event], Player],
        on_end: Callable[[], None],
    ) -> None:
        self.dropped = 0  # packets that came while too many waited
        self._stopping = threading.Event()
        self.buffer, self.player = buffer, make_player(self._stopping)
        self._packets: deque[tuple[bytes, float]] = deque()
        self._on_end = on_end
        self._wake = threading.Event()
        self._thread = threading.Thread(target=self._run, name="pebble-playback", daemon=True)

    def open(self) -> None:
        self._thread.start()

    def close(self) -> None:
        self._stopping.set()
        self._wake.set()
        if self._thread.is_alive():
            self._thread.join(_END_S)

    def put(self, payload: bytes) -> None:
        """Queue one packet that has just arrived."""
        if len(self._packets) >= _WAITING_PACKETS:
            self.dropped += 1
            self._packets.popleft()
        self._packets.append((payload, time.monotonic()))
        self._wake.set()

    def _run(self) -> None:
        try:
            while not self._stopping.is_set():
                wait = self.buffer.wait(time.monotonic())
                self._wake.wait(_IDLE_S if wait is None else wait)
                self._wake.clear()
                self._play()
        finally:
            self.player.close()
            self._on_end()

    def _play(self) -> None:
        while self._packets:
            self.buffer.put(*self._packets.popleft())
        chunk = self.buffer.take(time.monotonic())
        if chunk is not None:
            self.player.play(chunk)
        elif self.buffer.wait(time.monotonic()) is None:
            self.player.idle()


class AudioReceiver(Service):
    """Its own connection receives packets, its own thread plays them; the service's thread only reports."""

    name = "audio_receiver"
    publishes = (MEDIA_REPORT,)
    client_name = "local-audio-receiver"

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        settings = self.config.services.mqtt_bridge.media.audio_receiver
        self._stopping = False
        self._meter = RateMeter()
        self._buffer = JitterBuffer(target_ms=settings.latency_ms)
        self._playback = PlaybackThread(
            self._buffer,
            lambda stopping: Player(settings, stopping),
            lambda: self.post(self._on_end),
        )
        self._remote = remote_transport(self.config, "audio-receiver")

    def start(self) -> None:
        self.on_stop(lambda: self.log.info("sound: %s", self._buffer.counters.snapshot()))
        self._playback.open()
        self.on_stop(self._playback.close)
        self._remote.open(timeout=0.0)
        self.on_stop(self._remote.close)
        address, security = self.addresses[AUDIO_STREAM], self.config.security
        topics = [with_name(address.topic, "+")] if security.named else []
        if not security.named or security.unnamed != "refuse":
            topics.append(address.topic)
        for topic in topics:
            self._remote.subscribe(topic, self._on_packet, qos=QoS(address.qos), echo=False, direct=True)

    def stop(self) -> None:
        self._stopping = True

    def _on_end(self) -> None:
        if not self._stopping:
            raise DeviceError("the thread that plays sound has ended")  # the launcher restarts this process

    def _on_packet(self, message: Message) -> None:
        """On the transport's thread. A retained packet is refused, because it is old."""
        if message.retain:
            self.counters.add("stale")
            return
        self.counters.add("packets")
        self.counters.add("bytes", len(message.payload))
        self._meter.add(self.clock(), len(message.payload))
        self._playback.put(message.payload)

    @every(1.0)
    def _report(self) -> None:
        now = self.clock()
        player, counted = self._playback.player, self._buffer.counters
        self.publish(
            MEDIA_REPORT,
            MediaReport(
                running=True,
                doing=player.doing or "is silent",
                encoding=self._buffer.encoding or None,
                rate=round(self._meter.rate(now), 2),
                bitrate=round(self._meter.bitrate(now)),
                dropped=self._playback.dropped + counted["overflow"] + counted["skipped"] + player.dropped,
                restarts=player.restarts,
                last_error=self._trouble(player),
            ),
            program=self.name,
        )

    def _trouble(self, player: Player) -> str | None:
        if self._remote.state is not State.CONNECTED:
            return self._remote.problem or "the remote side is away"
        return player.problem or None
