"""The link of a process to its launcher: it ends with the launcher, sends notes to it, and logs in its format."""

import ctypes
import logging
import os
import re
import signal
import sys
from collections.abc import Callable

from pebble.config.secret_text import without_secrets
from pebble.config.visible import shown
from pebble.runtime import notes
from pebble.runtime.output import NonBlockingWriter

#: A pipe to the launcher, for the notes of :class:`Notifier`.
NOTIFY_FD = "PEBBLE_NOTIFY_FD"
WANTED = "PEBBLE_WANTED"  # "name=encoding …": programs that an earlier process of this program requested
ENCODING = "PEBBLE_ENCODING"  # the encoding in the request that started this media program
LAUNCHER_PID = "PEBBLE_LAUNCHER_PID"
ALIVE_PERIOD_S = 1.0
_WHY = 200  # characters of a reason
_PATIENCE_S = 0.25  # for the reader of log lines, such as the launcher; while that stands still, no stop waits for it
LOG_FORMAT = "%(asctime)s [%(levelname)s] %(message)s"  # what the launcher's log forwarding reads (paper A.8.7)
TAG = re.compile(r"\[([^\]]+) (\d+)\] (.*)", re.DOTALL)  # of a line by ``tagged``
_PR_SET_PDEATHSIG = 1

log = logging.getLogger(__name__)


def set_up_logging(level: str) -> None:
    """Write log lines to stderr in the format that the launcher forwards; drop them while it has no room for them."""
    if not logging.getLogger().handlers:
        handler = logging.StreamHandler(NonBlockingWriter(sys.stderr.fileno(), _PATIENCE_S))
        handler.terminator = ""  # the writer adds it
        handler.setFormatter(MaskingFormatter(LOG_FORMAT, "%H:%M:%S"))
        logging.getLogger().addHandler(handler)
        set_log_level(level)


class MaskingFormatter(logging.Formatter):
    """A formatter that hides logins in lines and tracebacks, and characters that control a terminal."""

    def format(self, record: logging.LogRecord) -> str:
        return shown(without_secrets(super().format(record)))


def set_log_level(level: str) -> None:
    """Log from ``level`` on. An unchanged level is not set again: that would copy memory shared with the launcher."""
    if logging.getLevelName(logging.getLogger().level) != level:
        logging.getLogger().setLevel(level)


def tagged(part: str, pid: int, line: bytes) -> bytes:
    """Return a line of a child of this process, for stderr: the launcher logs it under ``part`` and ``pid``.

    ``part`` must not contain ``]``.
    """
    return f"[{part} {pid}] ".encode() + line + b"\n"


def die_with_launcher() -> None:
    """Ask the kernel to send SIGTERM when the launcher dies, so that a killed launcher leaves no orphans."""
    launcher = os.environ.get(LAUNCHER_PID)
    if launcher is None:
        return
    end_with_parent(signal.SIGTERM)
    if os.getppid() != int(launcher):  # it died before we could ask
        sys.exit(1)


def end_with_parent(number: int | None = None) -> None:
    """Ask the kernel to send this process the signal ``number``, by default SIGKILL, when its parent thread ends."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL if number is None else number)


def requested_encoding() -> str | None:
    """Return the encoding in the request that started this program; None for the configured encoding."""
    return os.environ.get(ENCODING) or None


class Notifier:
    """A sender of notes to the launcher. Without a launcher nothing is sent.

    A method returns False if the launcher was too busy to take the note: then call it again.
    """

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

    def request(self, program: str, on: bool, encoding: str = "") -> bool:
        """Request or release an on-demand program.

        Only a program with ``may_request`` (pebble.launcher.programs) may. Its requests expire 5 s after it has ended.
        """
        if self._fd is None and not self._no_launcher_logged:
            self._no_launcher_logged = True
            log.info("there is no launcher to start %s", program)
        return self._write(notes.Wanted(program, on, encoding))

    def hold(self, program: str, on: bool) -> bool:
        """End an on-demand program; with ``on`` False, or once this process ends, it may run. See :meth:`request`."""
        return self._write(notes.Held(program, on))

    def feature(self, name: str, has: bool) -> bool:
        """Report whether this process has a feature of pebble.launcher.features, which the capabilities then show."""
        return self._write(notes.Feature(name, has))

    def local(self, connected: bool, why: str = "") -> bool:
        """Report whether this process is connected to the robot's other processes."""
        return self._write(notes.Local(connected, _one_line(why)))

    def mcu(self, state: str, silent_ms: int | None, why: str = "", starts: int = 0) -> bool:
        """Report the state of this process's serial line: :class:`notes.Mcu`."""
        note = notes.Mcu(state, silent_ms, _one_line(why), starts)  # type: ignore[arg-type]  # the launcher checks
        return self._write(note)

    def reaches(self, owner: str, reached: bool) -> bool:
        """Report whether messages of a motor owner arrive here."""
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
    """Return a text for an operator: on one line, without passwords, not too long."""
    return "".join(char if char.isprintable() else " " for char in without_secrets(text))[:_WHY].strip()


class Reported:
    """A value that is sent to the launcher when it changes, until the launcher has taken it."""

    def __init__(self, send: Callable[..., bool], *assumed: object) -> None:
        """Make a reporter that calls ``send``. ``assumed``: the value that the launcher assumes at first."""
        self._send, self._known = send, assumed

    def report(self, *value: object) -> None:
        """Send ``value`` if the launcher does not know it yet. Call this regularly."""
        if value != self._known and self._send(*value):
            self._known = value
