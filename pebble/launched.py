"""What a process does because the launcher started it: die with it, tell it how things go, log as it reads."""

from __future__ import annotations

import ctypes
import logging
import os
import signal
import sys

NOTIFY_FD = "PEBBLE_NOTIFY_FD"  # a pipe to the launcher: "READY" once, then "ALIVE" every second
LAUNCHER_PID = "PEBBLE_LAUNCHER_PID"
ALIVE_PERIOD_S = 1.0
LOG_FORMAT = "%(asctime)s [%(levelname)s] %(message)s"  # what the launcher's log forwarding reads (paper A.8.7)
_PR_SET_PDEATHSIG = 1

log = logging.getLogger(__name__)


def set_up_logging(level: str) -> None:
    """Log lines go to stderr in the form that the launcher forwards."""
    logging.basicConfig(level=level, format=LOG_FORMAT, datefmt="%H:%M:%S", stream=sys.stderr)


def die_with_launcher() -> None:
    """Ask the kernel for SIGTERM when the launcher dies, so that a killed launcher leaves no orphans."""
    launcher = os.environ.get(LAUNCHER_PID)
    if launcher is None:
        return
    ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    if os.getppid() != int(launcher):  # it died before we could ask
        sys.exit(1)


class Notifier:
    """Tells the launcher that this service listens, and that its thread is not stuck; silent without a launcher."""

    def __init__(self) -> None:
        number = os.environ.get(NOTIFY_FD)
        self._fd = None if number is None else int(number)
        if self._fd is not None:
            os.set_blocking(self._fd, False)

    def ready(self) -> None:
        self._write(b"READY\n")

    def alive(self) -> None:
        self._write(b"ALIVE\n")

    def _write(self, line: bytes) -> None:
        if self._fd is None:
            return
        try:
            os.write(self._fd, line)
        except OSError:  # the launcher is gone or busy: the next sign of life tells
            log.debug("the launcher did not take %s", line)
