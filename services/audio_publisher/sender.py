"""From chunks of the microphone to packets on the wire, as few late ones as possible."""

from __future__ import annotations

import logging
from typing import Final

from pebble.config.later import AudioPublisher as Options
from pebble.errors import PebbleError
from pebble.media.sound import SOUND_ENCODINGS, SoundEncoder, make_sound_encoder, sequence_numbers
from pebble.services.audio_publisher.thrift import Thrift, steps
from pebble.services.audio_publisher.under_way import UnderWay
from pebble.transports import QoS, State, Transport
from pebble.transports.counters import Counters
from pebble.transports.frames import FrameInfo

log = logging.getLogger(__name__)

#: Of the oldest packet on the link, beyond a round trip: then the newest are dropped. On a slow link Opus gets smaller
#: (see .thrift); what it waits for are packets that were lost and are sent again. Measured behind `pebble impair` at
#: 64 kbit/s and 5 % loss, windows of 12 s: with 0.2 s it lost 3 to 8 % of the sound, with 0.5 s 0 to 1.5 %.
WAITING_LIMIT_S: Final = 0.2
OPUS_WAITING_LIMIT_S: Final = 0.5


class Sender:
    """One thread feeds it; ``wanted`` may be set, and all attributes read, by any other.

    ``counters``: packets, bytes (sent), dropped (the link was away or too slow), refused (not sound).
    """

    def __init__(
        self, options: Options, transport: Transport, topic: str, qos: QoS, counters: Counters, now: float
    ) -> None:
        self.counters = counters
        self.wanted: str = options.encoding
        self.problem = ""  # why it is not as wanted
        self.reduced = ""  # what is done about a slow link
        self.told = ""  # what is sent, for people
        self.encoding: str = options.encoding  # of what is sent
        self._options, self._transport, self._topic, self._qos = options, transport, topic, qos
        self._numbers = sequence_numbers()
        self._steps = steps(options.bundle, options.bitrate)
        self._thrift = Thrift(len(self._steps) - 1, now)
        self._under_way = UnderWay()
        self._encoder: SoundEncoder | None = None
        self._made_for: tuple[object, ...] = ()  # encoding, rate, channels and step

    def take(self, info: FrameInfo, pcm: bytes, now: float) -> None:
        """One chunk as the microphone gave it, at the monotonic time ``now``."""
        if info.format != "s16le" or not (0 < info.rate <= 384_000 and 0 < info.channels <= 8):
            self.counters.add("refused")
            return
        if self._transport.state is not State.CONNECTED:
            self.counters.add("dropped")
            self._under_way.clear()
            return
        age_s = self._age_s(now)
        if self.encoding == "opus":
            self._thrift.look(age_s, now)
        encoder = self._encoder_for(info.rate, info.channels)
        first_ms = info.captured_ms - round(1000 * len(pcm) / (2 * info.channels * info.rate))
        for packet in encoder.encode(pcm, first_ms):
            self._send(packet, age_s, now)

    def _age_s(self, now: float) -> float:
        outgoing = self._transport.outgoing
        return max(0.0, self._under_way.age_s(outgoing.waiting, now) - outgoing.round_trip_s)

    def _send(self, packet: bytes, age_s: float, now: float) -> None:
        limit_s = OPUS_WAITING_LIMIT_S if self.encoding == "opus" else WAITING_LIMIT_S
        if age_s > limit_s or not self._transport.publish(self._topic, packet, qos=self._qos):
            self.counters.add("dropped")
            return
        self._under_way.sent(len(packet), now)
        self.counters.add("packets")
        self.counters.add("bytes", len(packet))

    def _encoder_for(self, rate: int, channels: int) -> SoundEncoder:
        """The present one, or a new one if anything about it has to change; another step waits for a packet's end."""
        level = self._thrift.level if self.wanted == "opus" else 0
        needed = (self.wanted, rate, channels, level)
        same_sound = needed[:-1] == self._made_for[:-1]
        if self._encoder is None or (needed != self._made_for and not (same_sound and self._encoder.part_way)):
            self._made_for = needed
            self._encoder = self._make(*needed)
            self._tell(self._encoder, level)
        return self._encoder

    def _make(self, name: str, rate: int, channels: int, level: int) -> SoundEncoder:
        """One that cannot be made here is replaced by the form that everybody can make and read."""
        options, step = self._options, self._steps[level]
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

    def _tell(self, encoder: SoundEncoder, level: int) -> None:
        self.encoding = encoder.name
        self.reduced = self._steps[level].told if encoder.name == "opus" else ""
        shape = {1: "mono", 2: "stereo"}.get(encoder.channels, f"{encoder.channels} channels")
        self.told = f"{encoder.name} {encoder.rate / 1000:g} kHz {shape}"
        log.info("sound is sent as %s%s", self.told, f", with {self.reduced}" if self.reduced else "")


def encoding_of(asked: str | None, configured: str) -> str:
    """What a request means: unknown or absent is as configured."""
    return asked if asked is not None and asked in SOUND_ENCODINGS else configured
