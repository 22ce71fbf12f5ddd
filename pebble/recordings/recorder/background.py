"""What a recorder does beside writing: makes files durable, and finishes them."""

import logging
import os
import threading
import time
from collections import deque
from collections.abc import Callable

from pebble.recordings.recorder.lane import OpenFile
from pebble.runtime.memory import return_free_pages

log = logging.getLogger(__name__)


class Background:
    """Makes files durable every few seconds, and returns free memory; does what may take long, one after the other."""

    def __init__(self, period_s: float, note: Callable[[float], None]) -> None:
        self._period_s, self._note = period_s, note
        self._jobs: deque[Callable[[], None]] = deque()
        self._files: list[OpenFile] = []
        self._wake = threading.Condition()
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name="pebble-recorder-sync", daemon=True)

    @property
    def alive(self) -> bool:
        return self._thread.is_alive()

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        with self._wake:
            self._stopping = True
            self._wake.notify()
        self._thread.join()

    def do(self, job: Callable[[], None]) -> None:
        with self._wake:
            self._jobs.append(job)
            self._wake.notify()

    def watch(self, files: list[OpenFile]) -> None:
        with self._wake:
            self._files = files

    def _run(self) -> None:
        synced = time.monotonic()
        while True:
            with self._wake:
                if not self._jobs and not self._stopping:
                    self._wake.wait(max(0.0, synced + self._period_s - time.monotonic()))
                job = self._jobs.popleft() if self._jobs else None
                files = list(self._files)
                if job is None and self._stopping:
                    return
            if job is not None:
                self._do(job)
            if time.monotonic() - synced >= self._period_s:
                synced = time.monotonic()
                for file in files:
                    self._sync(file)
                return_free_pages()

    def _do(self, job: Callable[[], None]) -> None:
        try:
            job()
        except Exception:  # one file must not keep the others from being finished
            log.exception("a recording could not be finished")

    def _sync(self, file: OpenFile) -> None:
        began = time.monotonic()
        try:
            descriptor = os.dup(file.file.fileno())
        except (OSError, ValueError):  # closed meanwhile
            return
        try:
            os.fdatasync(descriptor)
        except OSError as error:
            log.error("%s cannot be made durable: %s", file.path.name, error.strerror)
        finally:
            os.close(descriptor)
        self._note(time.monotonic() - began)
