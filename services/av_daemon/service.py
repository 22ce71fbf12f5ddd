"""Owns camera and microphone, and says how pictures and sound fare."""

from __future__ import annotations

import re
import time

from msgspec.structs import replace

from pebble.contract import MEDIA_REPORT, MEDIA_STATUS
from pebble.payloads import MediaReport, MediaStatus
from pebble.service import Service, every, on
from pebble.services.av_daemon import sources
from pebble.services.av_daemon.board import Board
from pebble.services.av_daemon.stream import Stream
from pebble.transports.frames import FrameWriter

CAMERA, MICROPHONE = "camera", "microphone"  # the names of the streams
_FIGURES_S = 5.0  # between messages that differ in figures alone: once a second they filled a tenth of a 64 kbit/s link
_NUMBER = re.compile(r"[0-9.]+")


class AvDaemon(Service):
    """Each device has a thread of its own, and is open only while somebody reads its stream."""

    name = "av_daemon"
    publishes = (MEDIA_STATUS,)

    def start(self) -> None:
        options = self.config.services.av_daemon
        now = time.monotonic()
        self._board = Board()
        self._said: dict[str, MediaReport] | None = None
        self._said_at = float("-inf")
        self._writers: list[FrameWriter] = []
        self._streams: list[Stream] = []
        if options.video.enabled:
            self._add(CAMERA, sources.picture_bytes(options), sources.camera(options, now))
        if options.audio.enabled:
            self._add(MICROPHONE, sources.chunk_bytes(options), sources.microphone(options, now))

    def stop(self) -> None:
        streams, writers = getattr(self, "_streams", []), getattr(self, "_writers", [])
        for stream in streams:
            stream.end()
        for stream in streams:
            stream.join()
        for writer in writers:
            writer.close()
        self._say({stream.name: MediaReport(running=False, doing="ended") for stream in streams})

    @property
    def republish_interval_s(self) -> float:
        return self.config.services.av_daemon.retained_publish_interval_seconds

    @on(MEDIA_REPORT)
    def hear(self, report: MediaReport, program: str) -> None:
        self._board.hear(program, report, time.monotonic())

    @every(0.5)
    def look(self) -> None:
        """Notice devices that hang."""
        now = time.monotonic()
        for stream in self._streams:
            stream.look(now)

    @every(1.0)
    def say(self) -> None:
        """Tell what has changed, at most once a second, and every few seconds if that is but figures."""
        now = time.monotonic()
        own = {stream.name: stream.report(now) for stream in self._streams}
        self._say(self._board.heard(now) | own)

    def _say(self, value: dict[str, MediaReport]) -> None:
        now = time.monotonic()
        if value == self._said:
            return
        if self._said is None or _states(value) != _states(self._said) or now - self._said_at >= _FIGURES_S:
            self._said, self._said_at = value, now
            self.publish(MEDIA_STATUS, MediaStatus(t=int(time.time() * 1000), value=value))

    def _add(self, name: str, size: int, open_source: sources.Opener) -> None:
        writer = FrameWriter(self.config.run_dir(), name, capacity=size)
        writer.open()
        self._writers.append(writer)
        delay = self.config.services.av_daemon.restart_delay_seconds
        self._streams.append(Stream(name, writer, open_source, restart_delay_s=delay))


def _states(value: dict[str, MediaReport]) -> dict[str, MediaReport]:
    """Without what changes all the time while nothing happens."""
    return {
        name: replace(
            report,
            doing=_words(report.doing),
            last_error=_words(report.last_error),
            rate=None,
            bitrate=None,
            dropped=None,
        )
        for name, report in value.items()
    }


def _words(text: str | None) -> str | None:
    return text and _NUMBER.sub("", text)
