"""The service that sends the microphone's sound, with as little delay as possible."""

import threading
from typing import Any

from pebble.contract import AUDIO, AUDIO_CONTROL, MEDIA_REPORT
from pebble.contract.payloads import MediaReport, MediaRequest
from pebble.errors import DeviceError, PebbleError
from pebble.extensions.media.config import Media
from pebble.extensions.media.frames import FrameInfo, FrameReader
from pebble.extensions.media.rate_meter import RateMeter
from pebble.extensions.media.sound import SOUND_ENCODINGS, SoundEncoder, make_sound_encoder, sequence_numbers
from pebble.runtime.connections import remote_transport
from pebble.runtime.parent import requested_encoding
from pebble.runtime.service import Service, every, on
from pebble.services.audio_publisher.rate_control import RateController, Step
from pebble.transports import QoS, State
from pebble.transports.counters import in_words

_DEPTH = 10  # chunks of 20 ms that may wait for the sender: the rest of what may be late
_QUIET_S = 2.0  # without sound from the microphone before that is reported
_END_S = 1.0  # for the microphone's thread to end


class AudioPublisher(Service):
    """The sender of sound. A thread reads, encodes and sends; the service's thread handles requests and reports.

    ``counters``: packets, bytes (sent), dropped (no connection, or one that is too slow), refused (not sound).
    """

    name = "audio_publisher"
    client_name = "local-audio-publisher"

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._options = section = self.config.section(Media).audio_publisher
        self._stopping = False
        self._received_at = self.clock()  # the newest piece of sound
        self._remote = remote_transport(self.config, "audio-publisher")
        self._address = self.addresses[AUDIO]
        thin = self.config.services.mqtt_bridge.link.profile != "wide"
        self._rate = RateController(
            section.bundle, section.bitrate, self._received_at, lambda: self._remote.outgoing, thin=thin
        )
        self._meter, self._numbers = RateMeter(), sequence_numbers()
        self._requested = self._known(requested_encoding())  # the encoding that is wanted now
        self._encoder: SoundEncoder | None = None
        self._made_for: tuple[object, ...] = ()  # for what the encoder was made: encoding, rate and channels
        self._made_step: Step | None = None  # and for which step of the rate control
        self._problem = ""  # why sound is not sent as requested
        self.reduced = ""  # because of a slow connection
        self._reader = FrameReader(self.config.run_dir(), "microphone", sharing=False, depth=_DEPTH)
        self._thread = threading.Thread(target=self._read, name="pebble-microphone", daemon=True)

    def start(self) -> None:
        self.on_stop(lambda: self.log.info("sound: %s", in_words(self.counters.snapshot())))
        self._remote.open(timeout=0.0)
        self.on_stop(self._remote.close)
        self._reader.open()
        self._thread.start()
        self.on_stop(lambda: self._thread.join(_END_S))
        self.on_stop(self._reader.close)  # it is called before join, as it was added later: it ends the thread

    def stop(self) -> None:
        self._stopping = True

    @on(AUDIO_CONTROL)
    def control(self, request: MediaRequest) -> None:
        if request.enabled:  # else the launcher is about to stop this process
            self._requested = self._known(request.encoding)

    def _known(self, requested: str | None) -> str:
        """Return the requested encoding if this installation has it, else the configured one."""
        return requested if requested is not None and requested in SOUND_ENCODINGS else self._options.encoding

    @property
    def encoding(self) -> str:
        """Present encoding."""
        return self._options.encoding if self._encoder is None else self._encoder.name

    # -- the microphone's thread

    def _read(self) -> None:
        try:
            for frame in self._reader:
                self._received_at = self.clock()
                self.take(frame.info, frame.data.tobytes(), self._received_at)
                frame.release()
        finally:
            self.post(self._on_end)

    def _on_end(self) -> None:
        if not self._stopping:
            raise DeviceError("the thread that reads the microphone has ended")  # the launcher restarts this process

    def take(self, info: FrameInfo, pcm: bytes, now: float) -> None:
        """Send a piece of the microphone's sound, received at the monotonic time ``now``."""
        if info.format != "s16le" or not (0 < info.rate <= 384_000 and 0 < info.channels <= 8):
            self.counters.add("refused")
            return
        if not self._connected:
            self.counters.add("dropped")
            self._rate.connection_lost()
            return
        self._rate.poll(now, self.encoding)
        encoder = self._encoder_for(info.rate, info.channels)
        # captured_ms is when the piece was complete: the time of its end.
        first_ms = info.captured_ms - round(1000 * len(pcm) / (2 * info.channels * info.rate))
        for packet in encoder.encode(pcm, first_ms):
            self._send_packet(packet, now)

    def _send_packet(self, packet: bytes, now: float) -> None:
        may_send, address = self._rate.may_send(self.encoding), self._address
        if not may_send or not self._remote.publish(address.topic, packet, qos=QoS(address.qos)):
            self.counters.add("dropped")
            return
        self._rate.sent(len(packet), now)
        self._meter.add(now, len(packet))
        self.counters.add("packets")
        self.counters.add("bytes", len(packet))

    def _encoder_for(self, rate: int, channels: int) -> SoundEncoder:
        """Return the encoder, or another one if its settings must change.

        If only the rate control's :class:`Step` changes, that waits for the end of a packet.
        """
        step = self._rate.step
        needed = (self._requested, rate, channels)
        may_change_step = self._encoder is None or not self._encoder.part_way
        if self._encoder is None or needed != self._made_for or (step != self._made_step and may_change_step):
            self._made_for, self._made_step = needed, step
            self._encoder = self._make(*needed, step)
            self.reduced = step.reduced if self._encoder.name == "opus" else ""
            reduced = f", with {self.reduced}" if self.reduced else ""
            self.log.info("sound is sent as %s%s", _format(self._encoder), reduced)
        return self._encoder

    def _make(self, name: str, rate: int, channels: int, step: Step) -> SoundEncoder:
        """Return an encoder called ``name``.

        If it cannot be made, return the one that every robot has and every client reads.
        """
        options = self._options
        self._problem = ""
        for attempt in (name, "pcm"):
            try:
                return make_sound_encoder(
                    attempt,
                    rate=rate,
                    channels=channels,
                    chunk_ms=options.chunk_ms,
                    bitrate=step.bitrate,
                    bundle=step.bundle,
                    sent_rate=options.rate,
                    sent_channels=options.channels,
                    numbers=self._numbers,
                )
            except PebbleError as error:
                self._problem = str(error)
                self.log.warning("sound cannot be sent as %s: %s", attempt, error)
        raise PebbleError(self._problem)

    @every(1.0)
    def _report(self) -> None:
        now, unread = self.clock(), self._reader.counters
        bitrate = self._meter.bitrate(now)
        report = MediaReport(
            running=True,
            doing=self._doing(bitrate),
            encoding=self.encoding,
            rate=round(self._meter.rate(now), 2),
            bitrate=round(bitrate),
            # Chunks that this process was too slow for, and packets that the connection was too slow for.
            dropped=self.counters["dropped"] + unread["skipped"] + unread["missed"] + unread["torn"],
            reduced=self.reduced or None,
            last_error=self._trouble(now) or None,
        )
        self.publish(MEDIA_REPORT, report, program=self.name)

    def _doing(self, bitrate: float) -> str:
        if not self._connected:
            return "rests: the remote side is away"
        if self._encoder is None:
            return "waits for the microphone"
        return f"{_format(self._encoder)}, {bitrate / 1000:.0f} kbit/s"

    def _trouble(self, now: float) -> str:
        if not self._connected:
            return self._remote.problem
        quiet_s = now - self._received_at
        if quiet_s > _QUIET_S:
            return f"no sound from the microphone for {quiet_s:.0f} s"
        return self._problem or self._reader.problem

    @property
    def _connected(self) -> bool:
        return self._remote.state is State.CONNECTED


def _format(encoder: SoundEncoder) -> str:
    shape = {1: "mono", 2: "stereo"}.get(encoder.channels, f"{encoder.channels} channels")
    return f"{encoder.name} {encoder.rate / 1000:g} kHz {shape}"
