"""The recorder: receives without waiting, writes on one thread, syncs to disk on another.

Only those two threads ever wait for the disk. The queue is bounded and drops pictures and sound before state. Every
lost message is counted, and the loss is recorded as soon as there is room.
"""

import logging
import os
import threading
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from pebble.extensions.recordings.files.recorded import require_package
from pebble.extensions.recordings.recorder.background import Background
from pebble.extensions.recordings.recorder.clock import Due, RecordingClock
from pebble.extensions.recordings.recorder.folder import Folder
from pebble.extensions.recordings.recorder.intake import FORGET, Clocks, Intake
from pebble.extensions.recordings.recorder.settings import Options
from pebble.extensions.recordings.recorder.writing import Context, Writing
from pebble.extensions.recordings.stamps import is_media
from pebble.runtime.rate_limit import RateLimitedLog

log = logging.getLogger(__name__)

LARGEST_PAYLOAD: Final = 16 << 20
FLUSH_S: Final = 1.0  # a kill loses as much
QUEUE_BYTES: Final = 64 << 20
_TICK_S: Final = 0.2
_SUSPENDED_S: Final = 0.5


class Recorder:
    """A recorder into one folder. :meth:`receive` may be called by any thread, and never waits."""

    def __init__(
        self, root: Path, options: Options, about: Mapping[str, str] | None = None, clocks: Clocks | None = None
    ) -> None:
        self.folder, self.options = Folder(root), options
        self.counters: Counter[str] = Counter()
        self._clocks = clocks or Clocks()
        self.clock = RecordingClock(self._clocks.wall_ns, self._clocks.boot_ns)
        self._intake = Intake(QUEUE_BYTES, self._clocks, self.clock, self.counters)
        self.note, self.note_gap = self._intake.note, self._intake.note_gap
        self._background = Background()
        context = Context(self.folder, options, self.clock, self.counters, {"format": "1", **(about or {})})
        self._writing = Writing(context, self._intake, self._background)
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._write, name="pebble-recorder", daemon=True)
        self._quiet_log = RateLimitedLog(log, period_s=60.0)

    def start(self) -> None:
        """Start. Raises PebbleError if the folder cannot be used or the package ``mcap`` is not installed."""
        require_package()
        self.folder.take()
        leftovers = self._writing.mend_leftovers()
        self.note("start", pid=os.getpid(), leftovers=leftovers)
        self._background.start()
        self._thread.start()

    def stop(self) -> None:
        """Write everything that was received, and finish the files."""
        self.note("stop")
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
        """Queue a message. ``retained``: an old value, which the broker sent for a new subscription.

        ``qos``, ``retain``: as it was published; None if unknown. ``source``: the name of its connection, if there are
        several.
        """
        if topic.startswith("$recorder/") or len(payload) > LARGEST_PAYLOAD:  # such topics are the recorder's own
            self.counters["refused"] += 1
        elif self.options.media or not is_media(payload):
            self._intake.add(topic, payload, qos, retain, "1" if retained else "", source)  # see Item.retained

    def forget_retained(self, source: str) -> None:
        """Forget the retained values of a connection, as they are fetched again."""
        self._intake.add_order(FORGET, source)

    @property
    def blocked(self) -> str:
        """Return why no file can be written now; empty if one can."""
        return self._writing.blocked

    @property
    def alive(self) -> bool:
        return self._thread.is_alive() and self._background.alive

    # -- the writer's thread

    def _write(self) -> None:
        due = Due(self._clocks.boot_ns)
        while True:
            stopping = self._stopping.wait(_TICK_S)
            try:
                self._turn(due, stopping=stopping)
            except Exception:  # noqa: BLE001  an unforeseen error must not end the recording
                self.counters["errors"] += 1
                self._quiet_log.exception("turn", "recording failed for a moment")
            if stopping:
                return

    def _turn(self, due: Due, *, stopping: bool) -> None:
        """Write what waits, and do what is due; ``stopping``: for the last time.

        Clock and disk come first: they decide the times of the messages, and whether they can be written at all. Events
        about them are in the queue then, and written with it.
        """
        flushing = stopping or due.every("flush", FLUSH_S)
        if flushing:
            self._follow_clock(due)
        self._writing.check_space(due, now_s=self._clocks.wall_ns() / 1e9)
        if flushing:
            self._writing.note_drops()
        if stopping:
            self._writing.try_again()  # if files could not be written
        for item in self._intake.take():
            self._writing.add(item)
        if flushing:
            self._writing.flush()
            self._writing.rotate(all_of_them=stopping)
        if stopping:
            self._writing.give_up()  # what still cannot be written

    def _follow_clock(self, due: Due) -> None:
        suspended_s = due.suspended_s(self._clocks.awake_ns())
        if suspended_s > _SUSPENDED_S:
            self.note_gap(self.clock.now() - round(suspended_s * 1e9), "suspended")
        offset_ns = self.clock.offset_ns
        by_s = self.clock.follow()
        if by_s:
            self.note("clock", by_s=round(by_s, 3), offset_before_ns=offset_ns)
            self._writing.flush()
            self._writing.rotate(all_of_them=True)  # within a file, times never go back
