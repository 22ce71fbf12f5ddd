"""The owner of camera and microphone; it publishes the status of everything that handles pictures and sound."""

import re
import time
from typing import Any, Final

import msgspec

from pebble.contract import MEDIA_REPORT, MEDIA_STATUS
from pebble.contract.payloads import MediaReport, MediaStatus
from pebble.errors import DeviceError
from pebble.extensions.media.frames import FrameWriter
from pebble.runtime.service import Service, every, on
from pebble.services.av_daemon import sources
from pebble.services.av_daemon.config import AvDaemon as AvDaemonSection
from pebble.services.av_daemon.health import Asked
from pebble.services.av_daemon.stream import Stream

CAMERA, MICROPHONE = "camera", "microphone"  # the names of the streams
_NUMBERS_S = 5.0  # between messages that differ in numbers alone: once a second they filled a tenth of a 64 kbit/s link
_PROGRAM_LIMIT = 32  # media programs whose reports are read
_NUMBER = re.compile(r"[0-9.]+")
SILENCE_S: Final = 5.0  # after which a program that has reported has ended


class Reports:
    """The latest report of each media program, by its name, until it stops reporting. Pure."""

    def __init__(self) -> None:
        self._reports: dict[str, tuple[float, MediaReport]] = {}

    def put(self, program: str, report: MediaReport, now: float) -> None:
        if program in self._reports or len(self._reports) < _PROGRAM_LIMIT:
            self._reports[program] = (now, report)

    def current(self, now: float) -> dict[str, MediaReport]:
        """Return the reports of the last SILENCE_S seconds, by program name."""
        self._reports = {name: (at, report) for name, (at, report) in self._reports.items() if now - at < SILENCE_S}
        return {name: self._reports[name][1] for name in sorted(self._reports)}


class AvDaemon(Service):
    """The owner of the devices. Each has a thread, and is open only while its stream has a reader."""

    name = "av_daemon"

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._reports = Reports()
        self._published: dict[str, MediaReport] | None = None
        self._published_at = float("-inf")
        self._streams: list[Stream] = []
        self._writers: list[FrameWriter] = []

    def start(self) -> None:
        options, now = self.config.section(AvDaemonSection), self.clock()
        if options.video.enabled:
            asked = sources.asked_of_camera(options.video)
            self._open(CAMERA, sources.picture_bytes(options), sources.camera(options, now), asked)
        if options.audio.enabled:
            asked = sources.asked_of_microphone(options.audio)
            self._open(MICROPHONE, sources.chunk_bytes(options), sources.microphone(options, now), asked)

    def stop(self) -> None:
        for stream in self._streams:
            stream.end()
        for stream in self._streams:
            stream.join()
        self._publish({stream.name: MediaReport(running=False, doing="ended") for stream in self._streams})

    @on(MEDIA_REPORT)
    def take_report(self, report: MediaReport, program: str) -> None:
        self._reports.put(program, report, self.clock())

    @every(0.5)
    def poll(self) -> None:
        """Find devices that hang."""
        now = self.clock()
        for stream in self._streams:
            stream.poll(now)

    @every(1.0)
    def look(self) -> None:
        """End this process, to be restarted, if its shared memory was removed, or if /dev/shm has room at last."""
        if not all(writer.in_place for writer in self._writers):
            raise DeviceError("the shared memory of the frames was removed: starting again with a new one")
        if any(writer.may_share for writer in self._writers):
            raise DeviceError("there is room for the frames in shared memory now: starting again to use it")

    @every(1.0)
    def publish_status(self) -> None:
        """Publish a changed status: within a few seconds if only its numbers have changed, else within a second."""
        now = self.clock()
        streams = {stream.name: stream.report(now) for stream in self._streams}
        self._publish(self._reports.current(now) | streams)

    def _publish(self, value: dict[str, MediaReport]) -> None:
        now = self.clock()
        if value == self._published:
            return
        only_numbers = self._published is not None and _states(value) == _states(self._published)
        if not only_numbers or now - self._published_at >= _NUMBERS_S:  # numbers alone are not sent so often
            self._published, self._published_at = value, now
            self.publish(MEDIA_STATUS, MediaStatus(t=int(time.time() * 1000), value=value))

    def _open(self, name: str, size: int, open_source: sources.Opener, asked: Asked | None) -> None:
        writer = FrameWriter(self.config.run_dir(), name, capacity=size)
        writer.open()
        self.on_stop(writer.close)
        self._writers.append(writer)
        self._streams.append(Stream(name, writer, open_source, asked=asked))


def _states(value: dict[str, MediaReport]) -> str:
    """Return the status as text without its numbers, which change all the time."""
    return _NUMBER.sub("", msgspec.json.encode(value).decode())
