"""A microphone in this process, one media program in its own, a stand-in for aplay, and an operator who listens."""

from __future__ import annotations

import threading
import time
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from pebble.media.sound import ReceivedSound, SoundDecoder
from pebble.media.speech import Speech
from pebble.transports import Message, QoS
from pebble.transports.frames import FrameInfo, FrameWriter
from tests.services.media_rig import BASE, MediaProgram, client
from tests.support import until

CHUNK_MS = 20

# Appends what it hears to a file that is named after how it was called.
RECORDER = """
import os, sys, time
folder, rate, channels, device = sys.argv[1:]
with open(f"{folder}/{time.monotonic_ns():020}-{rate}-{channels}-{device}-{os.getpid()}.raw", "wb", buffering=0) as out:
    while chunk := os.read(0, 4096):
        out.write(chunk)
"""


class Mouth:
    """Says the speech into the microphone's stream, 20 ms at a time, while anybody listens."""

    def __init__(self, folder: Path, rate: int = 16000, channels: int = 1) -> None:
        self.speech, self.rate, self.channels = Speech(rate, channels), rate, channels
        self._count = rate * CHUNK_MS // 1000
        self.writer = FrameWriter(folder, "microphone", capacity=self._count * 2 * channels, slots=16)
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> Self:
        self.writer.open()
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self._stopping.set()
        self._thread.join(10)
        self.writer.close()

    def _run(self) -> None:
        began, number = time.monotonic(), 0
        while not self._stopping.wait(max(0.0, began + number * CHUNK_MS / 1000 - time.monotonic())):
            number += 1
            info = FrameInfo(
                captured_ns=time.monotonic_ns(),
                captured_ms=time.time_ns() // 1_000_000,
                format="s16le",
                rate=self.rate,
                channels=self.channels,
            )
            if self.writer.wanted:
                self.writer.write(self.speech.samples((number - 1) * self._count, self._count).tobytes(), info)


class Ear:
    """An operator who decodes every packet of the robot's sound."""

    def __init__(self, port: int) -> None:
        self.transport = client("ear", port)
        self.received: list[ReceivedSound] = []
        self.arrived: list[float] = []  # epoch seconds
        self.decoder = SoundDecoder()
        self.transport.subscribe(f"{BASE}/outgoing/audio", self._listen, qos=QoS.LATEST)

    def close(self) -> None:
        self.transport.close()

    def wait(self, count: int, timeout: float = 20.0) -> list[ReceivedSound]:
        """Until so many packets more have come; returns these."""
        before = len(self.received)
        assert until(lambda: len(self.received) >= before + count, timeout), (
            f"{len(self.received) - before} packets came"
        )
        return self.received[before:]

    def wait_for(self, encoding: str) -> None:
        assert until(lambda: bool(self.received) and self.received[-1].encoding == encoding, 20), f"no {encoding} came"

    def _listen(self, message: Message) -> None:
        one = self.decoder.feed(message.payload)
        if one is not None:
            self.arrived.append(time.time())
            self.received.append(one)


class Program(MediaProgram):
    """The publisher or the receiver."""

    def __init__(self, name: str, kind: str, local_port: int, remote_port: int, **options: Any) -> None:
        super().__init__(name, name, "audio", kind, local_port, remote_port, **options)
