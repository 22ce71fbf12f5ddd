"""What a process does because the launcher started it: die with it, tell it how things go, log as it reads."""

from __future__ import annotations

import ctypes
import errno
import logging
import os
import shutil
import signal
import sys
from collections.abc import Sequence
from typing import NamedTuple

NOTIFY_FD = "PEBBLE_NOTIFY_FD"  # a pipe to the launcher: "READY" once, "ALIVE" every second, and "WANT …"
WANTED = "PEBBLE_WANTED"  # "name=encoding …": what a predecessor of this process had wanted, and what still runs
ENCODING = "PEBBLE_ENCODING"  # the form that was asked for when this media program was wanted
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
    end_with_parent(signal.SIGTERM)
    if os.getppid() != int(launcher):  # it died before we could ask
        sys.exit(1)


def end_with_parent(number: int = signal.SIGKILL) -> None:
    """The kernel sends this process ``number`` when the thread that started it is gone."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, number)


def tied(command: Sequence[str], number: signal.Signals = signal.SIGKILL) -> list[str]:
    """``command``, to be started so that it gets ``number`` when the thread that starts it is gone.

    Until setpriv has asked for that, a few milliseconds, it is tied to nobody.
    Raises FileNotFoundError if there is no such program. Not by ``preexec_fn``: between fork and exec, Python 3.11.2
    may wait for ever for a lock that a thread of Zenoh held.
    """
    if shutil.which(command[0]) is None:
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), command[0])
    return ["setpriv", "--pdeathsig", number.name.removeprefix("SIG"), "--", *command]


class Want(NamedTuple):
    """Whether an on-demand program is to run, and which encoding it is to begin with; empty: as configured."""

    on: bool
    encoding: str = ""


def wanted_before() -> dict[str, Want]:
    """The on-demand programs that run because our predecessor wanted them."""
    words = (word.partition("=") for word in os.environ.get(WANTED, "").split())
    return {name: Want(on=True, encoding=encoding) for name, _, encoding in words}


def encoding_asked_for() -> str | None:
    """What the request asked for that has this program run; None: nothing special. Later ones it hears by itself."""
    return os.environ.get(ENCODING) or None


class Notifier:
    """Tells the launcher that this service listens, and that its thread is not stuck; silent without a launcher."""

    def __init__(self) -> None:
        number = os.environ.get(NOTIFY_FD)
        self._fd = None if number is None else int(number)
        if self._fd is not None:
            os.set_blocking(self._fd, False)
        self._said_alone = False

    def ready(self) -> None:
        self._write(b"READY\n")

    def alive(self) -> None:
        self._write(b"ALIVE\n")

    def want(self, program: str, want: Want) -> bool:
        """Have an on-demand program run, or run no more. False: say it again, the launcher was too busy to hear it.

        Only a program that may ask (pebble.launcher.programs) is listened to. When it ends, its wants count for
        another 5 s.
        """
        if self._fd is None and not self._said_alone:
            self._said_alone = True
            log.info("there is no launcher: others have to start %s", program)
        return self._write(f"WANT {program} {int(want.on)} {want.encoding}".rstrip().encode() + b"\n")

    def _write(self, line: bytes) -> bool:
        if self._fd is None:
            return True
        try:
            os.write(self._fd, line)  # a line is short: the pipe takes the whole of it, or nothing
        except OSError:  # the launcher is gone or busy: the next sign of life tells
            log.debug("the launcher did not take %s", line)
            return False
        return True
