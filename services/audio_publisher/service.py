"""Sends what the microphone hears to operators."""

from __future__ import annotations

import threading
import time

from pebble.contract import AUDIO, AUDIO_CONTROL, MEDIA_REPORT
from pebble.errors import LinkError
from pebble.launched import encoding_asked_for
from pebble.links import remote_transport
from pebble.media.rates import Rates
from pebble.payloads import MediaReport, MediaRequest
from pebble.service import Service, every, on
from pebble.services.audio_publisher.sender import Sender, encoding_of
from pebble.transports import QoS, State
from pebble.transports.frames import FrameReader

_DEPTH = 10  # chunks of 20 ms that may wait for us: the rest of what may be late
_QUIET_S = 2.0  # without sound from the microphone before that is reported
_END_S = 1.0  # for the listening thread to end


class AudioPublisher(Service):
    """A thread listens, encodes and sends; what operators ask for and what is reported goes through the service's."""

    name = "audio_publisher"
    publishes = (MEDIA_REPORT, AUDIO)
    client_name = "local-audio-publisher"

    def start(self) -> None:
        self._options = self.config.services.mqtt_bridge.media.audio_publisher
        self._stopping = False
        self._heard_at = time.monotonic()
        self._rates = Rates()
        self._remote = remote_transport(self.config, "audio-publisher").open(timeout=0.0)
        address = self.addresses[AUDIO]
        self._sender = Sender(
            self._options, self._remote, address.topic, QoS(address.qos), self.counters, time.monotonic()
        )
        self._sender.wanted = encoding_of(encoding_asked_for(), self._options.encoding)
        self._reader = FrameReader(self.config.run_dir(), "microphone", depth=_DEPTH).open()
        self._thread = threading.Thread(target=self._hear, args=(self._reader,), name="pebble-microphone", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        self._stopping = True
        if hasattr(self, "_thread"):
            self._reader.close()
            self._thread.join(_END_S)
        if hasattr(self, "_remote"):
            self._remote.close()
            self.log.info("sound: %s", self.counters.snapshot())

    @on(AUDIO_CONTROL)
    def control(self, request: MediaRequest) -> None:
        if request.enabled:  # else we are about to be stopped
            self._sender.wanted = encoding_of(request.encoding, self._options.encoding)

    # -- the listening thread

    def _hear(self, reader: FrameReader) -> None:
        try:
            for frame in reader:
                self._heard_at = time.monotonic()
                self._sender.take(frame.info, frame.data.tobytes(), self._heard_at)
                frame.release()
        finally:
            self.post(self._on_end)

    def _on_end(self) -> None:
        if not self._stopping:
            raise LinkError("the thread that listens to the microphone has ended")  # the launcher starts us again

    # -- how it goes

    @every(1.0)
    def _report(self) -> None:
        rate, bitrate = self._rates.look(self.counters["packets"], self.counters["bytes"], time.monotonic())
        sender = self._sender
        self.publish(
            MEDIA_REPORT,
            MediaReport(
                running=True,
                doing=self._doing(bitrate),
                encoding=sender.encoding,
                rate=round(rate, 2),
                bitrate=round(bitrate),
                dropped=self._dropped(),
                reduced=sender.reduced or None,
                last_error=self._trouble(),
            ),
            program=self.name,
        )

    def _dropped(self) -> int:
        """Chunks we were too slow for, and packets the link was."""
        lost = self._reader.counters
        return self.counters["dropped"] + lost["skipped"] + lost["missed"] + lost["torn"]

    def _doing(self, bitrate: float) -> str:
        if not self._connected:
            return "rests: the remote side is away"
        return f"{self._sender.told}, {bitrate / 1000:.0f} kbit/s" if self._sender.told else "waits for the microphone"

    def _trouble(self) -> str | None:
        if not self._connected:
            return self._remote.problem or None
        quiet_s = time.monotonic() - self._heard_at
        if quiet_s > _QUIET_S:
            return f"no sound from the microphone for {quiet_s:.0f} s"
        return self._sender.problem or self._reader.problem or None

    @property
    def _connected(self) -> bool:
        return self._remote.state is State.CONNECTED
