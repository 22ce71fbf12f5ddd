"""Records messages into files: receives at once, writes on one thread, makes durable on another.

Whatever happens to the disk, nothing here waits for it but those two threads: the queue is bounded, drops pictures and
sound before state, and every message that is lost is counted, and written down as soon as there is room.
"""

from __future__ import annotations

import json
import logging
import os
import threading
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Final

import msgspec

from pebble.recordings.files.mcap import LARGEST_PAYLOAD
from pebble.recordings.recorder.background import Background
from pebble.recordings.recorder.clock import RecordingClock
from pebble.recordings.recorder.disk_space import Limits
from pebble.recordings.recorder.due import Due
from pebble.recordings.recorder.folder import Folder
from pebble.recordings.recorder.intake import FORGET, Clocks, Intake
from pebble.recordings.recorder.writing import Writing
from pebble.recordings.stamps import is_media
from pebble.runtime.rate_limit import RateLimitedLog

log = logging.getLogger(__name__)

_TICK_S: Final = 0.2
_LATE_S: Final = 0.5

Positive = Annotated[float, msgspec.Meta(ge=0.1)]
Size = Annotated[int, msgspec.Meta(ge=0)]


class Options(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How a recorder records; sizes in bytes. 0 in ``keep_…``: no limit."""

    rotate_seconds: Positive = 3600.0
    rotate_bytes: Annotated[int, msgspec.Meta(ge=1 << 16)] = 512 << 20
    keep_bytes: Size = 0
    keep_media_days: Annotated[float, msgspec.Meta(ge=0)] = 0.0
    keep_state_days: Annotated[float, msgspec.Meta(ge=0)] = 0.0
    free_bytes: Size = 2 << 30
    flush_seconds: Positive = 1.0
    sync_seconds: Positive = 5.0
    level: Annotated[int, msgspec.Meta(ge=0, le=19)] = 3  # of Zstandard's compression; 0: none
    queue_bytes: Annotated[int, msgspec.Meta(ge=1 << 18)] = 64 << 20
    media: bool = True

    @property
    def limits(self) -> Limits:
        return Limits(self.keep_bytes, self.keep_media_days, self.keep_state_days, self.free_bytes)


class Recorder:
    """One folder. :meth:`receive` may be called by any thread, and never waits."""

    def __init__(
        self, root: Path, options: Options, about: Mapping[str, str] | None = None, clocks: Clocks | None = None
    ) -> None:
        self.folder, self.options = Folder(root), options
        self.counters: Counter[str] = Counter()
        self.slowest_sync_s = 0.0
        self._clocks = clocks or Clocks()
        self.clock = RecordingClock(self._clocks.wall_ns, self._clocks.boot_ns)
        self._intake = Intake(options.queue_bytes, self._clocks, self.counters)
        self._background = Background(options.sync_seconds, self._note_sync)
        self._writing = Writing(self, self._intake, self._background, {"format": "1", **(about or {})})
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._write, name="pebble-recorder", daemon=True)
        self._quiet_log = RateLimitedLog(log, period_s=60.0)

    def start(self) -> None:
        """Raises RecordingError if the folder cannot be used."""
        self.folder.take()
        left = self._writing.mend_leftovers()
        self.event("start", pid=os.getpid(), leftovers=left)
        self._background.start()
        self._thread.start()

    def stop(self) -> None:
        """Write all that was received, and finish the files."""
        self.event("stop")
        self._stopping.set()
        self._thread.join()
        self._background.stop()
        self.folder.release()

    # -- any thread

    def receive(
        self,
        topic: str,
        payload: bytes,
        qos: int | None,
        retain: bool | None,
        *,
        retained: bool = False,
        source: str = "",
    ) -> None:
        """Queue a message; ``retained``: an old value, which a broker sent after subscribing.

        ``qos``, ``retain``: as it was published; None where that is unknown.
        """
        if topic.startswith("$recorder/") or len(payload) > LARGEST_PAYLOAD:
            self.counters["refused"] += 1
        elif self.options.media or not is_media(payload):
            self._intake.add(topic, payload, qos, retain, "1" if retained else "", source)

    def forget_retained(self, source: str) -> None:
        """The retained values of a connection are fetched anew."""
        self._intake.add_order(FORGET, source)

    def event(self, name: str, **about: Any) -> None:
        """Write down what happened to the recording itself."""
        boot_ns = self._clocks.boot_ns()
        payload = json.dumps({"t": self.clock.at(boot_ns) // 10**6, "event": name, **about}).encode()
        self._intake.add_event(payload, boot_ns)
        self.counters[f"event_{name}"] += 1

    def gap(self, since_ns: int, why: str, **about: Any) -> None:
        """Write down that nothing was recorded since ``since_ns`` (since 1970)."""
        now_ns = self.clock.now()
        self.event("gap", since=since_ns // 10**6, until=now_ns // 10**6, why=why, **about)

    @property
    def blocked(self) -> str:
        """Why nothing is written at present; empty if it is."""
        return self._writing.blocked

    @property
    def alive(self) -> bool:
        """Whether its threads run."""
        return self._thread.is_alive() and self._background.alive

    @property
    def slowest_flush_s(self) -> float:
        return self._writing.slowest_flush_s

    @property
    def waiting(self) -> int:
        return len(self._intake)

    @property
    def robots(self) -> dict[str, float]:
        """When each robot was received last, in seconds since 1970."""
        return dict(self._intake.robots)

    # -- the writer's thread

    def _write(self) -> None:
        due = Due(self._clocks.boot_ns)
        while True:
            stopping = self._stopping.wait(_TICK_S)
            late_s = due.late_s(_TICK_S)
            if late_s > _LATE_S:
                self.event("late", max_ms=round(late_s * 1000))
            try:
                self._turn(due, stopping=stopping)
            except Exception:  # noqa: BLE001  an unforeseen error must not end the recording
                self.counters["errors"] += 1
                self._quiet_log.exception("turn", "recording failed for a moment")
            if stopping:
                return

    def _turn(self, due: Due, *, stopping: bool) -> None:
        flushing = stopping or due.every("flush", self.options.flush_seconds)
        if flushing:
            self._follow_clock(due)
        self._writing.check_space(due, now_s=self._clocks.wall_ns() / 1e9)
        if flushing:
            self._writing.note_drops()
        if stopping:
            self._writing.try_again()
        for item in self._intake.take():
            self._writing.add(item)
        if flushing:
            self._writing.flush()
            self._writing.rotate(all_of_them=stopping)
        if stopping:
            self._writing.give_up()

    def _follow_clock(self, due: Due) -> None:
        suspended_s = due.suspended_s(self._clocks.awake_ns())
        if suspended_s > _LATE_S:
            self.gap(self.clock.now() - round(suspended_s * 1e9), "suspended")
        offset_ns = self.clock.offset_ns
        by_s = self.clock.follow()
        if by_s:
            self.event("clock", by_s=round(by_s, 3), offset_before_ns=offset_ns)
            self._writing.flush()
            self._writing.rotate(all_of_them=True)

    # -- the background thread

    def _note_sync(self, seconds: float) -> None:
        self.slowest_sync_s = max(self.slowest_sync_s, seconds)
