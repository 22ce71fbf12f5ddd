"""The service that plays an operator's voice."""

import threading
import time
from collections import deque
from typing import Any

from pebble.contract import AUDIO_STREAM, MEDIA_REPORT
from pebble.contract.names import with_name
from pebble.contract.payloads import MediaReport
from pebble.errors import DeviceError
from pebble.extensions.media.config import Media
from pebble.extensions.media.jitter import JitterBuffer
from pebble.extensions.media.rate_meter import RateMeter
from pebble.runtime.connections import remote_transport
from pebble.runtime.service import Service, every
from pebble.services.audio_receiver.player import Player
from pebble.transports import Message, QoS, State
from pebble.transports.counters import in_words

_IDLE_S = 0.5  # between two checks whether it has been silent for long
_END_S = 1.5
_WAITING_PACKETS = 48  # that wait to be played


class AudioReceiver(Service):
    """The service that plays voices.

    A connection receives packets, a thread plays them; the service's own thread only reports.
    """

    name = "audio_receiver"
    client_name = "local-audio-receiver"

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        settings = self.config.section(Media).audio_receiver
        self._stopping, self._wake = threading.Event(), threading.Event()
        self._meter = RateMeter()
        self._buffer = JitterBuffer(target_ms=settings.latency_ms)
        self._player = Player(settings, self._stopping)
        self._packets: deque[tuple[bytes, float]] = deque(maxlen=_WAITING_PACKETS)  # and when each came
        self._thread = threading.Thread(target=self._play, name="pebble-playback", daemon=True)
        self._remote = remote_transport(self.config, "audio-receiver")

    def start(self) -> None:
        self.on_stop(lambda: self.log.info("sound: %s", in_words(self._buffer.counters.snapshot())))
        self._thread.start()
        self.on_stop(lambda: self._thread.join(_END_S))
        self._remote.open(timeout=0.0)
        self.on_stop(self._remote.close)
        address, security = self.addresses[AUDIO_STREAM], self.config.security
        # At the level named: senders with a name, and others only if strangers are not refused.
        topics = [with_name(address.topic, "+")] if security.named else []
        if not security.named or security.unnamed != "refuse":
            topics.append(address.topic)
        for topic in topics:
            self._remote.subscribe(topic, self._on_packet, qos=QoS(address.qos), echo=False, direct=True)

    def stop(self) -> None:
        self._stopping.set()
        self._wake.set()

    # -- the thread between the network and the playing program, on which writes may block

    def _play(self) -> None:
        """Put packets that come into the buffer, and play the sound that is due, until the service stops."""
        try:
            while not self._stopping.is_set():
                wait = self._buffer.wait(time.monotonic())
                self._wake.wait(_IDLE_S if wait is None else wait)
                self._wake.clear()
                while self._packets:
                    self._buffer.put(*self._packets.popleft())
                chunk = self._buffer.take(time.monotonic())
                if chunk is not None:
                    self._player.play(chunk)
                elif self._buffer.wait(time.monotonic()) is None:  # nothing is due before another packet comes
                    self._player.idle()
        finally:
            self._player.close()
            self.post(self._on_end)

    def _on_end(self) -> None:
        if not self._stopping.is_set():
            raise DeviceError("the thread that plays sound has ended")  # the launcher restarts this process

    # -- the transport's thread

    def _on_packet(self, message: Message) -> None:
        """Queue a packet; a retained one is refused, because it is old."""
        if message.retain:
            self.counters.add("stale")
            return
        self.counters.add("packets")
        self.counters.add("bytes", len(message.payload))
        self._meter.add(self.clock(), len(message.payload))
        if len(self._packets) == _WAITING_PACKETS:  # the oldest goes
            self.counters.add("dropped")
        self._packets.append((message.payload, time.monotonic()))  # the clock of `_play`
        self._wake.set()

    @every(1.0)
    def _report(self) -> None:
        now = self.clock()
        player, counted = self._player, self._buffer.counters
        self.publish(
            MEDIA_REPORT,
            MediaReport(
                running=True,
                doing=player.doing or "is silent",
                encoding=self._buffer.encoding or None,
                rate=round(self._meter.rate(now), 2),
                bitrate=round(self._meter.bitrate(now)),
                dropped=self.counters["dropped"] + counted["overflow"] + counted["skipped"] + player.dropped,
                restarts=player.restarts,
                last_error=self._trouble(),
            ),
            program=self.name,
        )

    def _trouble(self) -> str | None:
        if self._remote.state is not State.CONNECTED:
            return self._remote.problem or "the remote side is away"
        return self._player.problem or None
