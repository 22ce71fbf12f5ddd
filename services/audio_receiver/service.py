"""Plays an operator's voice."""

from __future__ import annotations

import time

from pebble.contract import AUDIO_STREAM, MEDIA_REPORT
from pebble.errors import LinkError
from pebble.links import remote_transport
from pebble.media.jitter import JitterBuffer
from pebble.media.rates import Rates
from pebble.payloads import MediaReport
from pebble.service import Service, every
from pebble.services.audio_receiver.player import Player
from pebble.services.audio_receiver.speaker import Speaker
from pebble.transports import Message, QoS, State


class AudioReceiver(Service):
    """Its own connection brings packets, its own thread plays them; the service's thread only reports."""

    name = "audio_receiver"
    publishes = (MEDIA_REPORT,)
    client_name = "local-audio-receiver"

    def start(self) -> None:
        options = self.config.services.mqtt_bridge.media.audio_receiver
        self._stopping = False
        self._rates = Rates()
        self._buffer = JitterBuffer(
            limit=options.queue_limit, concealment_ms=options.concealment_ms, target_ms=options.latency_ms
        )
        self._speaker = Speaker(
            self._buffer,
            lambda stopping: Player(options.command, options.device, stopping),
            options.queue_limit,
            lambda: self.post(self._on_end),
        )
        self._speaker.open()
        self._remote = remote_transport(self.config, "audio-receiver").open(timeout=0.0)
        address = self.addresses[AUDIO_STREAM]
        self._remote.subscribe(address.topic, self._arrive, qos=QoS(address.qos), echo=False, direct=True)

    def stop(self) -> None:
        self._stopping = True
        if hasattr(self, "_remote"):
            self._remote.close()
        if hasattr(self, "_speaker"):
            self._speaker.close()
            self.log.info("sound: %s", self._buffer.counters.snapshot())

    def _on_end(self) -> None:
        if not self._stopping:
            raise LinkError("the thread that plays sound has ended")  # and so do we: the launcher starts us again

    def _arrive(self, message: Message) -> None:
        """On the transport's thread. Nobody keeps a voice: a kept copy is old."""
        if message.retain:
            self.counters.add("stale")
            return
        self.counters.add("packets")
        self.counters.add("bytes", len(message.payload))
        self._speaker.put(message.payload)

    @every(1.0)
    def _report(self) -> None:
        rate, bitrate = self._rates.look(self.counters["packets"], self.counters["bytes"], time.monotonic())
        player, counted = self._speaker.player, self._buffer.counters
        self.publish(
            MEDIA_REPORT,
            MediaReport(
                running=True,
                doing=player.told or "is silent",
                encoding=self._buffer.encoding or None,
                rate=round(rate, 2),
                bitrate=round(bitrate),
                dropped=self._speaker.dropped + counted["overflow"] + counted["skipped"] + player.dropped,
                restarts=player.restarts,
                last_error=self._trouble(player),
            ),
            program=self.name,
        )

    def _trouble(self, player: Player) -> str | None:
        if self._remote.state is not State.CONNECTED:
            return self._remote.problem or "the remote side is away"
        return player.problem or None
