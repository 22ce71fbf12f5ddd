"""Sends the microphone's sound to operators."""

import threading
from typing import Any

from pebble.contract import AUDIO, AUDIO_CONTROL, MEDIA_REPORT
from pebble.contract.payloads import MediaReport, MediaRequest
from pebble.errors import DeviceError
from pebble.runtime.connections import remote_transport
from pebble.runtime.parent import requested_encoding
from pebble.runtime.service import Service, every, on
from pebble.services.audio_publisher.sender import Sender, known_encoding
from pebble.transports import QoS, State
from pebble.transports.frames import FrameReader

_DEPTH = 10  # chunks of 20 ms that may wait for the sender: the rest of what may be late
_QUIET_S = 2.0  # without sound from the microphone before that is reported
_END_S = 1.0  # for the microphone's thread to end


class AudioPublisher(Service):
    """A thread reads, encodes and sends; the service's thread handles requests and reports."""

    name = "audio_publisher"
    publishes = (MEDIA_REPORT, AUDIO)
    client_name = "local-audio-publisher"

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._options = self.config.services.mqtt_bridge.media.audio_publisher
        self._stopping = False
        self._received_at = self.clock()
        self._remote = remote_transport(self.config, "audio-publisher")
        address = self.addresses[AUDIO]
        self._sender = Sender(
            self._options,
            self._remote,
            address.topic,
            QoS(address.qos),
            self.counters,
            self._received_at,
            thin=self.config.services.mqtt_bridge.link.profile != "wide",
        )
        self._sender.requested = known_encoding(requested_encoding(), self._options.encoding)
        self._reader = FrameReader(self.config.run_dir(), "microphone", sharing=False, depth=_DEPTH)
        self._thread = threading.Thread(target=self._read, name="pebble-microphone", daemon=True)

    def start(self) -> None:
        self.on_stop(lambda: self.log.info("sound: %s", self.counters.snapshot()))
        self._remote.open(timeout=0.0)
        self.on_stop(self._remote.close)
        self._reader.open()
        self._thread.start()
        self.on_stop(lambda: self._thread.join(_END_S))
        self.on_stop(self._reader.close)

    def stop(self) -> None:
        self._stopping = True

    @on(AUDIO_CONTROL)
    def control(self, request: MediaRequest) -> None:
        if request.enabled:  # else the launcher is about to stop this process
            self._sender.requested = known_encoding(request.encoding, self._options.encoding)

    # -- the microphone's thread

    def _read(self) -> None:
        try:
            for frame in self._reader:
                self._received_at = self.clock()
                self._sender.take(frame.info, frame.data.tobytes(), self._received_at)
                frame.release()
        finally:
            self.post(self._on_end)

    def _on_end(self) -> None:
        if not self._stopping:
            raise DeviceError("the thread that reads the microphone has ended")  # the launcher restarts this process

    # -- the report

    @every(1.0)
    def _report(self) -> None:
        sender, now = self._sender, self.clock()
        bitrate = sender.meter.bitrate(now)
        self.publish(
            MEDIA_REPORT,
            MediaReport(
                running=True,
                doing=self._doing(bitrate),
                encoding=sender.encoding,
                rate=round(sender.meter.rate(now), 2),
                bitrate=round(bitrate),
                dropped=self._dropped(),
                reduced=sender.reduced or None,
                last_error=self._trouble(),
            ),
            program=self.name,
        )

    def _dropped(self) -> int:
        """Chunks that this process was too slow for, and packets that the connection was too slow for."""
        lost = self._reader.counters
        return self.counters["dropped"] + lost["skipped"] + lost["missed"] + lost["torn"]

    def _doing(self, bitrate: float) -> str:
        if not self._connected:
            return "rests: the remote side is away"
        if not self._sender.format:
            return "waits for the microphone"
        return f"{self._sender.format}, {bitrate / 1000:.0f} kbit/s"

    def _trouble(self) -> str | None:
        if not self._connected:
            return self._remote.problem or None
        quiet_s = self.clock() - self._received_at
        if quiet_s > _QUIET_S:
            return f"no sound from the microphone for {quiet_s:.0f} s"
        return self._sender.problem or self._reader.problem or None

    @property
    def _connected(self) -> bool:
        return self._remote.state is State.CONNECTED
