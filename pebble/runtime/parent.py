"""What a process owes the launcher that started it: end with it, notify it, and log in the format it reads."""

import ctypes
import errno
import logging
import os
import re
import shutil
import signal
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

from pebble.config import LAUNCHER_LOCK
from pebble.config.secret_text import without_secrets
from pebble.config.visible import shown
from pebble.ownership import read_plain
from pebble.runtime import notes

#: A pipe to the launcher, for the notes of :class:`Notifier`.
NOTIFY_FD = "PEBBLE_NOTIFY_FD"
WANTED = "PEBBLE_WANTED"  # "name=encoding …": running programs that a predecessor of this process requested
ENCODING = "PEBBLE_ENCODING"  # the encoding in the request that started this media program
LAUNCHER_PID = "PEBBLE_LAUNCHER_PID"
ALIVE_PERIOD_S = 1.0
_WHY = 200  # characters of a reason
LOG_FORMAT = "%(asctime)s [%(levelname)s] %(message)s"  # what the launcher's log forwarding reads (paper A.8.7)
TAG = re.compile(r"\[([^\]]+) (\d+)\] (.*)", re.DOTALL)  # of a line by ``tagged``
_PR_SET_PDEATHSIG = 1

log = logging.getLogger(__name__)


def set_up_logging(level: str) -> None:
    """Write log lines to stderr in the format that the launcher forwards."""
    new = None if _logs_from(level) else level
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(MaskingFormatter(LOG_FORMAT, "%H:%M:%S"))
    logging.basicConfig(level=new, handlers=[handler])


class MaskingFormatter(logging.Formatter):
    """Hides logins in lines and tracebacks, whatever program or library they come from, and what steers a terminal."""

    def format(self, record: logging.LogRecord) -> str:
        return shown(without_secrets(super().format(record)))


def set_log_level(level: str) -> None:
    """Log from ``level`` on. Setting it writes into each logger, memory that this process shares with its launcher."""
    if not _logs_from(level):
        logging.getLogger().setLevel(level)


def _logs_from(level: str) -> bool:
    return logging.getLevelName(logging.getLogger().level) == level


def tagged(part: str, pid: int, line: bytes) -> bytes:
    """Return a line that a process of this process wrote, for stderr: the launcher logs it under ``part`` and ``pid``.

    ``part`` contains no ``]``.
    """
    return f"[{part} {pid}] ".encode() + line + b"\n"


def die_with_launcher() -> None:
    """Ask the kernel for SIGTERM when the launcher dies, so that a killed launcher leaves no orphans."""
    launcher = os.environ.get(LAUNCHER_PID)
    if launcher is None:
        return
    end_with_parent(signal.SIGTERM)
    if os.getppid() != int(launcher):  # it died before we could ask
        sys.exit(1)


def end_with_parent(number: int | None = None) -> None:
    """Have the kernel send this process ``number``, SIGKILL unless given, when the thread that started it has ended."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL if number is None else number)


def tied_to_parent(command: Sequence[str], number: signal.Signals | None = None) -> list[str]:
    """Extend ``command`` so that the process gets ``number``, else SIGKILL, when the thread that starts it has ended.

    This holds from a few milliseconds after the start on, when setpriv has asked the kernel for it.
    Raises FileNotFoundError if there is no such program. Not by ``preexec_fn``: between fork and exec, Python 3.11.2
    may wait for ever for a lock that a thread of Zenoh held.
    """
    if shutil.which(command[0]) is None:
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), command[0])
    name = (signal.SIGKILL if number is None else number).name.removeprefix("SIG")
    return ["setpriv", "--pdeathsig", name, "--", *command]


def launcher_runs(run_dir: Path) -> bool:
    """True if the newest launcher of the robot with this run directory is still a running process."""
    try:
        pid = int(read_plain(run_dir / LAUNCHER_LOCK).partition(b"\n")[0])
        os.kill(pid, 0)
    except (OSError, ValueError, OverflowError):
        return False
    return True


class ProgramRequest(NamedTuple):
    """Whether an on-demand program is to run, and the encoding it begins with; empty: as configured."""

    on: bool
    encoding: str = ""


def earlier_requests() -> dict[str, ProgramRequest]:
    """Return the on-demand programs that run because a predecessor of this process requested them."""
    words = (word.partition("=") for word in os.environ.get(WANTED, "").split())
    return {name: ProgramRequest(on=True, encoding=encoding) for name, _, encoding in words}


def requested_encoding() -> str | None:
    """Return the encoding in the request that started this program; None: as configured. Later ones it hears itself."""
    return os.environ.get(ENCODING) or None


class Notifier:
    """Notifies the launcher that this process is ready and alive; does nothing without a launcher."""

    def __init__(self) -> None:
        number = os.environ.get(NOTIFY_FD)
        self._fd = None if number is None else int(number)
        if self._fd is not None:
            os.set_blocking(self._fd, False)
        self._no_launcher_logged = False

    def ready(self) -> None:
        self._write(notes.Ready())

    def alive(self) -> None:
        self._write(notes.Alive())

    def request(self, program: str, request: ProgramRequest) -> bool:
        """Request or release an on-demand program. False: the launcher was too busy, repeat it.

        Only programs with ``may_request`` (pebble.launcher.programs) may; their requests expire 5 s after their end.
        """
        if self._fd is None and not self._no_launcher_logged:
            self._no_launcher_logged = True
            log.info("there is no launcher to start %s", program)
        return self._write(notes.Wanted(program, request.on, request.encoding))

    def hold(self, program: str, on: bool) -> bool:
        """Let an on-demand program wait, at most until this process ends, or no longer; as :meth:`request`."""
        return self._write(notes.Held(program, on))

    def feature(self, name: str, has: bool) -> bool:
        """Report that this process can provide a feature, or cannot, until it ends; the capabilities follow.

        Features are listed in pebble.launcher.features. False: the launcher was too busy, repeat it.
        """
        return self._write(notes.Feature(name, has))

    def local(self, connected: bool, why: str = "") -> bool:
        """Report whether this process is connected to its siblings. False: the launcher was too busy, repeat it."""
        return self._write(notes.Local(connected, _one_line(why)))

    def mcu(self, state: str, silent_ms: int | None, why: str = "", starts: int = 0) -> bool:
        """Report on this process's serial line, as :class:`notes.Mcu` has it. False: repeat it."""
        note = notes.Mcu(state, silent_ms, _one_line(why), starts)  # type: ignore[arg-type]  # the launcher checks
        return self._write(note)

    def reaches(self, owner: str, reached: bool) -> bool:
        """Report whether what a motor owner publishes arrives here. False: the launcher was too busy, repeat it."""
        return self._write(notes.Reach(owner, reached))

    def _write(self, note: notes.Note) -> bool:
        if self._fd is None:
            return True
        try:
            os.write(self._fd, notes.encode(note) + b"\n")  # short: the pipe takes all of it or nothing
        except OSError:  # the launcher is gone or busy: the next sign of life may reach it
            log.debug("the launcher did not take %s", note)
            return False
        return True


def _one_line(text: str) -> str:
    """Return the text for an operator: on one line, without passwords, not too long."""
    return "".join(one if one.isprintable() else " " for one in without_secrets(text))[:_WHY].strip()


class Reported:
    """A value that the launcher is told when it has changed, and again until it takes it."""

    def __init__(self, send: Callable[..., bool], *known: object) -> None:
        """``known``: what the launcher takes for granted."""
        self._send, self._known = send, known

    def report(self, *value: object) -> None:
        """Report ``value`` if the launcher does not know it; call it regularly."""
        if value != self._known and self._send(*value):
            self._known = value
