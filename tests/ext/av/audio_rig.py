"""A microphone in this process, one media program in its own, a stand-in for aplay, and an operator who listens."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from pebble.extensions.media.frames import FrameInfo
from pebble.extensions.media.sound import ReceivedSound, SoundDecoder
from pebble.extensions.media.speech import Speech
from pebble.transports import Message
from tests.ext.av.media_rig import Device, MediaProgram, Operator

CHUNK_MS = 20

# Appends what it hears to a file that is named after how it was called.
RECORDER = """
import os, sys, time
folder, rate, channels, device = sys.argv[1:]
with open(f"{folder}/{time.monotonic_ns():020}-{rate}-{channels}-{device}-{os.getpid()}.raw", "wb", buffering=0) as out:
    while chunk := os.read(0, 4096):
        out.write(chunk)
"""


class Mouth(Device):
    """Says the speech into the microphone's stream, 20 ms at a time."""

    def __init__(self, folder: Path, rate: int = 16000, channels: int = 1) -> None:
        self.speech, self._form = Speech(rate, channels), {"format": "s16le", "rate": rate, "channels": channels}
        self._count = rate * CHUNK_MS // 1000
        super().__init__(folder, "microphone", 1000 / CHUNK_MS, self._count * 2 * channels, slots=16)

    def write(self, number: int) -> None:
        now = {"captured_ns": time.monotonic_ns(), "captured_ms": time.time_ns() // 1_000_000}
        samples = self.speech.samples((number - 1) * self._count, self._count)
        self.writer.write(samples.tobytes(), FrameInfo(**now, **self._form))


class Ear(Operator[ReceivedSound]):
    """Decodes every packet of the robot's sound."""

    def __init__(self, port: int) -> None:
        self.arrived: list[float] = []  # epoch seconds
        self.decoder = SoundDecoder()
        super().__init__(port, "audio")

    def receive(self, message: Message) -> None:
        one = self.decoder.feed(message.payload)
        if one is not None:
            self.arrived.append(time.time())
            self.received.append(one)


class Program(MediaProgram):
    """The publisher or the receiver."""

    def __init__(self, name: str, kind: str, local_port: int, remote_port: int, **options: Any) -> None:
        super().__init__(name, name, "audio", kind, local_port, remote_port, **options)
