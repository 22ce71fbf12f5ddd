"""What the sender does with sound while the link takes nothing."""

from __future__ import annotations

from itertools import pairwise

import pytest

from pebble.config.media import AudioPublisher as Options
from pebble.contract.packets import Sound
from pebble.services.audio_publisher.sender import Sender
from pebble.transports import Message, QoS, State, Transport
from pebble.transports.base import Outgoing, Subscription
from pebble.transports.counters import Counters
from pebble.transports.frames import FrameInfo

CHUNK_S = 0.02
CHUNK = bytes(640)  # 20 ms at 16 kHz
SOUND = FrameInfo(format="s16le", rate=16_000, channels=1, captured_ms=1)


class Stuck(Transport):
    """Accepts everything, and confirms none of it."""

    def __init__(self) -> None:
        super().__init__("stuck")
        self.accepted = 0
        self.packets: list[bytes] = []

    @property
    def outgoing(self) -> Outgoing:
        return Outgoing(waiting=self.accepted)

    def _open(self, timeout: float) -> None:
        self._set_state(State.CONNECTED)

    def _close(self, will: Message | None) -> None: ...

    def _send(self, message: Message, urgent: bool) -> bool:
        self.accepted += len(message.payload) + 60
        self.packets.append(message.payload)
        return True

    def _declare(self, subscription: Subscription) -> None: ...

    def _undeclare(self, subscription: Subscription) -> None: ...


class Behind(Stuck):
    """Confirms everything but the newest packets, ``behind`` of them."""

    behind = 0

    @property
    def outgoing(self) -> Outgoing:
        return Outgoing(waiting=sum(len(packet) + 60 for packet in self.packets[len(self.packets) - self.behind :]))


@pytest.mark.parametrize(("encoding", "most_s"), [("pcm", 0.2), ("opus", 0.5)])
def test_sound_waits_for_so_long_and_then_the_newest_is_dropped(encoding: str, most_s: float) -> None:
    counters, transport = Counters(), Stuck().open()
    sender = Sender(Options(encoding=encoding, bundle=1), transport, "sound", QoS.LATEST, counters, 0.0)  # type: ignore[arg-type]
    dropped_at = None
    for number in range(100):
        now = number * CHUNK_S
        sender.take(SOUND, CHUNK, now)
        if counters["dropped"]:
            dropped_at = now
            break
    assert dropped_at == pytest.approx(most_s, abs=4 * CHUNK_S)  # Opus may wait for a bundle
    assert sender.encoding == encoding


def test_sound_gets_larger_and_smaller_and_none_is_lost() -> None:
    counters, transport = Counters(), Behind()
    transport.open()
    sender = Sender(Options(encoding="opus", bundle=2), transport, "sound", QoS.LATEST, counters, 0.0)  # type: ignore[arg-type]
    steps = []
    for number in range(1, 300):
        transport.behind = 7 if number > 150 else 0
        info = FrameInfo(format="s16le", rate=16_000, channels=1, captured_ms=20 * number)  # of its end
        sender.take(info, CHUNK, number * CHUNK_S)
        steps += [sender.reduced] if steps[-1:] != [sender.reduced] else []
    three, least = "3 parts a packet", "3 parts a packet, 16 kbit/s"
    assert steps == [least, three, "", three, least]
    received = [Sound.unpack(packet) for packet in transport.packets]
    ends_ms = [sound.captured_ms + sound.samples // 16 for sound in received]
    assert [sound.captured_ms for sound in received] == [0, *ends_ms[:-1]]
    assert counters["dropped"] == 0


@pytest.mark.parametrize(("thin", "rest_s"), [(True, 2.6), (False, 0.0)])
def test_on_a_thin_link_a_slow_packet_is_followed_by_a_rest(thin: bool, rest_s: float) -> None:
    counters, transport = Counters(), Behind()
    transport.open()
    sender = Sender(Options(encoding="opus", bundle=1), transport, "sound", QoS.LATEST, counters, 0.0, thin=thin)  # type: ignore[arg-type]
    sent_at = []
    for number in range(250):
        before, now = len(transport.packets), number * CHUNK_S
        transport.behind = 99 if now < 0.3 else 0
        sender.take(SOUND, CHUNK, now)
        sent_at += [now] * (len(transport.packets) - before)
    assert max(b - a for a, b in pairwise(sent_at)) == pytest.approx(rest_s, abs=0.1)
