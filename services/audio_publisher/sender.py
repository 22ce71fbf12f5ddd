"""From chunks of the microphone to packets on the wire, as few late ones as possible."""

import logging

from pebble.config.media import AudioPublisher as Options
from pebble.errors import PebbleError
from pebble.media.rate_meter import RateMeter
from pebble.media.sound import SOUND_ENCODINGS, SoundEncoder, make_sound_encoder, sequence_numbers
from pebble.services.audio_publisher.rate_control import RateController, Step
from pebble.transports import QoS, State, Transport
from pebble.transports.counters import Counters
from pebble.transports.frames import FrameInfo

log = logging.getLogger(__name__)


class Sender:
    """One thread feeds it; any other may set ``requested`` and read the other attributes.

    ``counters``: packets, bytes (sent), dropped (no connection, or one that is too slow), refused (not sound).
    """

    def __init__(
        self,
        options: Options,
        transport: Transport,
        topic: str,
        qos: QoS,
        counters: Counters,
        now: float,
        *,
        thin: bool = False,
    ) -> None:
        self.counters = counters
        self.meter = RateMeter()  # of what is sent
        self.requested: str = options.encoding
        self.encoding: str = options.encoding  # of what is sent
        self.problem = ""  # why it is not the requested one
        self.reduced = ""  # because of a slow connection
        self.format = ""  # of what is sent, for display
        self._options, self._transport, self._topic, self._qos = options, transport, topic, qos
        self._numbers = sequence_numbers()
        self._rate = RateController(options.bundle, options.bitrate, now, lambda: transport.outgoing, thin=thin)
        self._encoder: SoundEncoder | None = None
        self._made_for: tuple[object, ...] = ()  # encoding, rate, channels and step

    def take(self, info: FrameInfo, pcm: bytes, now: float) -> None:
        """One chunk as the microphone gave it, at the monotonic time ``now``."""
        if info.format != "s16le" or not (0 < info.rate <= 384_000 and 0 < info.channels <= 8):
            self.counters.add("refused")
            return
        if self._transport.state is not State.CONNECTED:
            self.counters.add("dropped")
            self._rate.connection_lost()
            return
        self._rate.poll(now, self.encoding)
        encoder = self._encoder_for(info.rate, info.channels)
        first_ms = info.captured_ms - round(1000 * len(pcm) / (2 * info.channels * info.rate))
        for packet in encoder.encode(pcm, first_ms):
            self._send(packet, now)

    def _send(self, packet: bytes, now: float) -> None:
        may_send = self._rate.may_send(self.encoding)
        if not may_send or not self._transport.publish(self._topic, packet, qos=self._qos):
            self.counters.add("dropped")
            return
        self._rate.sent(len(packet), now)
        self.meter.add(now, len(packet))
        self.counters.add("packets")
        self.counters.add("bytes", len(packet))

    def _encoder_for(self, rate: int, channels: int) -> SoundEncoder:
        """The present one, or a new one if anything about it has to change; another step waits for a packet's end."""
        step = self._rate.step if self.requested == "opus" else self._rate.configured
        needed = (self.requested, rate, channels, step)
        same_sound = needed[:-1] == self._made_for[:-1]
        if self._encoder is None or (needed != self._made_for and not (same_sound and self._encoder.part_way)):
            self._made_for = needed
            self._encoder = self._make(*needed)
            self._describe(self._encoder, step)
        return self._encoder

    def _make(self, name: str, rate: int, channels: int, step: Step) -> SoundEncoder:
        """The encoder called ``name``; where it cannot be made, the one that every robot has and every client reads."""
        options = self._options
        self.problem = ""
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
                self.problem = str(error)
                log.warning("sound cannot be sent as %s: %s", attempt, error)
        raise PebbleError(self.problem)

    def _describe(self, encoder: SoundEncoder, step: Step) -> None:
        self.encoding = encoder.name
        self.reduced = step.reduced if encoder.name == "opus" else ""
        shape = {1: "mono", 2: "stereo"}.get(encoder.channels, f"{encoder.channels} channels")
        self.format = f"{encoder.name} {encoder.rate / 1000:g} kHz {shape}"
        log.info("sound is sent as %s%s", self.format, f", with {self.reduced}" if self.reduced else "")


def known_encoding(requested: str | None, configured: str) -> str:
    """The requested encoding if this installation has it, else the configured one."""
    return requested if requested is not None and requested in SOUND_ENCODINGS else configured
