"""The recorder's threads beside the writer: they sync files to disk, and finish them."""

import ctypes
import logging
import os
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from typing import Final

from pebble.extensions.recordings.recorder.lane import OpenFile
from pebble.runtime.whole_file import sync_file

log = logging.getLogger(__name__)

SYNC_S: Final = 5.0  # a power cut loses as much


class Background:
    """Two threads: one syncs files every few seconds and returns free memory, the other does long jobs."""

    def __init__(self) -> None:
        self._jobs = ThreadPoolExecutor(1, "pebble-recorder-finish")
        self._files: list[OpenFile] = []
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._sync_all, name="pebble-recorder-sync", daemon=True)

    @property
    def alive(self) -> bool:
        return self._thread.is_alive()

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        """Wait until all jobs are done, and end the threads."""
        self._jobs.shutdown()
        self._stopping.set()
        self._thread.join()

    def do(self, job: Callable[[], None]) -> None:
        self._jobs.submit(_logged, job)

    def watch(self, files: list[OpenFile]) -> None:
        self._files = files

    def _sync_all(self) -> None:
        while not self._stopping.wait(SYNC_S):
            for file in self._files:
                self._sync(file)
            return_free_pages()

    def _sync(self, file: OpenFile) -> None:
        """Sync a file to disk by a descriptor of its own, as the writer may close the file meanwhile."""
        try:
            descriptor = os.dup(file.file.fileno())
        except (OSError, ValueError):  # closed meanwhile
            return
        try:
            sync_file(descriptor, data=True)
        except OSError as error:
            log.error("%s cannot be made durable: %s", file.path.name, error.strerror)
        finally:
            os.close(descriptor)


def _logged(job: Callable[[], None]) -> None:
    try:
        job()
    except Exception:  # one file must not keep the others from being finished
        log.exception("a recording could not be finished")


def return_free_pages() -> None:
    """Return unused pages of the heap to the system, with glibc.

    Glibc keeps them unless they are at the heap's end, so that a process which passes on messages of many sizes takes
    several megabytes more than it needs (measured: 7 of a recorder's 31 MB, once its files were rotated).
    """
    with suppress(AttributeError):  # musl
        ctypes.CDLL(None).malloc_trim(0)
