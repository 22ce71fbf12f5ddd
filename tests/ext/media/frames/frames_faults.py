"""Kills and stops readers and the writer in a random order."""

from __future__ import annotations

import random
import signal
import time
from typing import Any

import msgspec

from pebble.transports import segments
from tests.ext.media.frames.frames_net import FramesNet, Peer
from tests.support import until

VGA = 640 * 480 * 3
RATE = 30.0  # Hz
BETWEEN = 45  # frames from one fault to the next


class Figures(msgspec.Struct, kw_only=True):
    """What the run has shown."""

    written: int = 0  # by all writers together
    shares: list[float] = []  # of these, what each surviving reader got
    wrong: int = 0  # frames that were torn or out of order and not marked as invalid
    memory_kb: list[list[int]] = []  # of each survivor: resident after a third of the faults, and at the end
    segments_left: int = 0  # after the last process has ended, and one sweep


class Faults:
    def __init__(self, net: FramesNet, seed: int) -> None:
        self._net = net
        self._random = random.Random(seed)
        self.survivors = [net.reader(views=False), net.reader(views=True)]
        self._victims = [net.reader(views=True), net.reader(views=True, work_s=0.03)]
        self._writer = self._new_writer()  # last: frames written before there are readers are not lost
        self.figures = Figures()

    def run(self, faults: int) -> Figures:
        self._wait_until_quiet()
        for number in range(faults):
            fault = self._random.choice([self._kill_writer, self._kill_reader, self._kill_reader, self._stop_reader])
            fault()
            self._wait_until_quiet()
            if number in (faults // 3, faults - 1):
                self.figures.memory_kb.append([reader.ask()["rss"] for reader in self.survivors])
        return self._end()

    def _wait_until_quiet(self) -> None:
        """Wait until every running reader has read some more frames."""
        self._net.note_segments()
        before = [reader.ask()["frames"] for reader in self.survivors]
        for reader, frames in zip(self.survivors, before, strict=True):
            reader.has(frames=frames + BETWEEN)

    def _kill_writer(self) -> None:
        self._writer.kill()
        self._writer = self._new_writer()

    def _new_writer(self) -> Peer:
        return self._net.writer(size=VGA, rate=RATE)

    def _kill_reader(self) -> None:
        chosen = self._random.randrange(len(self._victims))
        self._victims[chosen].signal(signal.SIGCONT)
        self._victims[chosen].kill()
        self._victims[chosen] = self._net.reader(views=True, work_s=self._random.choice([0.0, 0.03]))

    def _stop_reader(self) -> None:
        for victim in self._victims:
            victim.signal(signal.SIGCONT)
        self._random.choice(self._victims).signal(signal.SIGSTOP)

    def _end(self) -> Figures:
        figures = self.figures
        self._writer.signal(signal.SIGKILL)
        figures.written = self._net.written()
        answers = [self._final(reader) for reader in self.survivors]
        figures.shares = [round(seen["received"] / figures.written, 4) for seen in answers]
        figures.wrong = sum(seen["wrong"] + seen["backwards"] for seen in answers)
        self._net.note_segments()
        self._net.close()
        time.sleep(segments.YOUNG_S)  # younger segments may be about to be locked
        segments.sweep()
        figures.segments_left = len(self._net.left())
        return figures

    @staticmethod
    def _final(reader: Peer) -> dict[str, Any]:
        """When nothing more arrives."""
        seen = [reader.ask()]

        def quiet() -> bool:
            seen.append(reader.ask())
            return seen[-1]["received"] == seen[-2]["received"]

        until(quiet, 5, step=0.1)
        return seen[-1]
