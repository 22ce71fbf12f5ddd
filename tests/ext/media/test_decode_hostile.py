"""Generated hostile packets among good ones: never a crash, never a wrong picture shown as right.

A packet that is well-formed and lies (another id, another picture, a damaged bare JPEG) cannot be told from an honest
one: what is shown from there to the next honest key frame is not judged. Everything else is.

``make test THOROUGH=1`` tries 100,000.
"""

from __future__ import annotations

import random
from collections.abc import Callable

import cv2
import numpy as np

from pebble.extensions.media.decode import Decoded, VideoDecoder
from pebble.extensions.media.jpeg import MAX_EDGE, Pixels
from pebble.extensions.media.video import make_encoder
from tests.support import cases

PACKETS = cases(2000, 100_000)
T0 = 1_710_969_600_000
HEADER = 19
LENGTH, INTERVAL = 40, 6
Stream = list[bytes]


def camera(sender: int, number: int) -> Pixels:
    made = np.full((48, 64, 3), (60 + 50 * sender, 120, 200 - 50 * sender), np.uint8)
    made[:: 5 + sender] = 30
    cv2.circle(made, (number * 5 % 64, 12 + 10 * sender), 9, (40, 60, 220), -1)
    return made


def streams() -> dict[str, list[Stream]]:
    """Each form has three senders, each with its own pictures, minutes apart."""
    made: dict[str, list[Stream]] = {}
    for form in ("json", "pbvd", "h264"):
        made[form] = []
        for sender in range(3):
            encoder = make_encoder(form, fps=15, keyframe_interval=INTERVAL, quality=20)
            start = T0 + sender * 100_000
            made[form].append([encoder.encode(camera(sender, n), start + n * 66) for n in range(LENGTH)])
    made["jpeg"] = [[cv2.imencode(".jpg", camera(sender, n))[1].tobytes() for n in range(9)] for sender in range(3)]
    return made


class Attack:
    """Feeds one decoder, and knows what each honest packet has to become."""

    def __init__(self) -> None:
        self.random = random.Random(1)
        self.streams = streams()
        self.truth: dict[bytes, Pixels] = {}
        for form in self.streams.values():
            for stream in form:
                honest = VideoDecoder()
                for packet in stream:
                    shown = honest.feed(packet)
                    assert shown is not None, honest.problem
                    self.truth[packet] = shown.picture
        self.decoder = VideoDecoder()
        self.fed = 0
        self.lied = False  # something unverifiable was shown, and no honest key frame since
        self.honestly_shown = 0
        self.form = "json"
        self.sender = self.at = 0

    @property
    def stream(self) -> Stream:
        return self.streams[self.form][self.sender]

    def step(self) -> None:
        what = self.random.choices([self.honest, self.lose, self.jump, self.repeat, self.attack], [10, 1, 1, 1, 6])[0]
        what()
        self.at %= len(self.stream)

    def honest(self) -> None:
        self.feed(self.stream[self.at], self.stream[self.at])
        self.at += 1

    def lose(self) -> None:
        self.at += self.random.randint(1, 8)

    def jump(self) -> None:
        """Another sender: a restart, a change of form, or two on one topic."""
        self.form = self.random.choice(list(self.streams))
        self.sender = self.random.randrange(3)
        self.at = self.random.randrange(len(self.stream))

    def repeat(self) -> None:
        old = self.random.choice(self.stream[max(0, self.at - 4) : self.at + 1])
        self.feed(old, old)

    def attack(self) -> None:
        packet = self.stream[self.at]
        checked = self.form in ("json", "h264")
        kind: Callable[[bytes], bytes] = self.random.choice([self.cut, self.flip, self.garbage, self.lie, self.splice])
        made = kind(packet)
        strict = kind in (self.cut, self.garbage) or (kind == self.flip and checked)
        self.feed(made, packet if strict else None)
        self.at += self.random.random() < 0.5  # instead of the honest one, or before it

    def feed(self, packet: bytes, right: bytes | None) -> None:
        """``right``: the honest packet whose picture this may show; None: that is unknown."""
        shown = self.decoder.feed(packet)
        self.fed += 1
        self.honestly_shown += shown is not None and packet == right
        right = packet if packet in self.truth else right
        if shown is not None:
            self._judge(shown, right)
        assert self.decoder.wants_keyframe is (shown is None)

    def _judge(self, shown: Decoded, right: bytes | None) -> None:
        assert shown.picture.dtype == np.uint8
        assert max(shown.picture.shape) <= MAX_EDGE
        if right is None:
            self.lied = True
        elif shown.keyframe or not self.lied:
            self.lied = False
            assert np.array_equal(shown.picture, self.truth[right]), (shown.encoding, shown.frame)

    # -- what is done to an honest packet

    def cut(self, packet: bytes) -> bytes:
        return packet[: self.random.choice([self.random.randrange(len(packet)), len(packet) - 1, len(packet) - 2])]

    def flip(self, packet: bytes) -> bytes:
        made = bytearray(packet)
        first = HEADER if packet.startswith(b"PBVD") else 0
        for _ in range(self.random.randint(1, 8)):
            made[self.random.randrange(first, len(made))] ^= 1 << self.random.randrange(8)
        return bytes(made)

    def garbage(self, packet: bytes) -> bytes:
        begin = self.random.choice([b"", b"{", b'{"id":', b"PBVD\x01\x01\x00", b"PBVD\x01\x05\x01", b"\xff\xd8\xff"])
        return begin + self.random.randbytes(self.random.randint(0, 300))

    def lie(self, packet: bytes) -> bytes:
        """Any byte of the header, or of the first fields of the JSON, is any other."""
        made = bytearray(packet)
        made[self.random.randrange(min(HEADER, len(made)))] = self.random.randrange(256)
        return bytes(made).replace(b'"id":', self.random.choice([b'"id":', b'"id":1e9', b'"id":-', b'"id":9'])[:8])

    def splice(self, packet: bytes) -> bytes:
        other = self.random.choice(self.stream)
        at = self.random.randrange(min(len(packet), len(other)))
        return packet[:at] + other[at:]


def test_hostile_packets() -> None:
    attack = Attack()
    while attack.fed < PACKETS:
        attack.step()
    attack.form, attack.sender, attack.at = "pbvd", 0, 0
    for _ in range(LENGTH):  # and afterwards it works as if nothing had been
        attack.honest()
    assert attack.decoder.feed(attack.stream[0]) is not None
    assert attack.honestly_shown > PACKETS / 5
