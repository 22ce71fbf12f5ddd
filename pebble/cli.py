"""The ``pebble`` command: errors become lines on stderr and an exit code.

0: success, also the end by SIGTERM of what runs until then. 1: failure, or no result. 2: the command line is wrong.
130: Ctrl-C.
"""

import errno
import gc
import os
import signal
import sys
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import TextIO

from pebble.errors import PebbleError

_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO)  # the output's disk is full, or its terminal has gone


def main() -> int:
    """Run the command line; return the exit code."""
    _use_utf8()
    _open_missing_streams()
    _accept_signals()
    sys.excepthook = _print_error
    for stream in (sys.stdout, sys.stderr):
        stream.reconfigure(errors="backslashreplace")  # type: ignore[union-attr]  # what a terminal cannot show
    try:
        code = _run(sys.argv[1:])
        sys.stdout.flush()
    except PebbleError as error:
        code = _fail(*_without_secrets(str(error)).splitlines())
    except UnicodeEncodeError as error:
        code = _fail(f"a name that is no UTF-8 cannot be used here, rename it: {error.object[:300]}")
    except KeyboardInterrupt:
        code = 130
    except BrokenPipeError:  # the reader has ended (`pebble topic contract | head`)
        code = 1
    except OSError as error:
        if error.filename is not None or error.errno not in _FULL:
            raise
        code = _fail(f"the output cannot be written: {error.strerror}")
    flushed = [_flushes(sys.stdout), _flushes(sys.stderr)]
    if code == 0 and not all(flushed):
        return 1
    return code


def _use_utf8() -> None:
    """Start again in UTF-8 mode if the locale has another encoding: file names hold names of robots."""
    if sys.getfilesystemencoding() != "utf-8" and not sys.flags.utf8_mode:
        os.environ["PYTHONUTF8"] = "1"  # for the programs that this one starts
        os.execv(sys.executable, [sys.executable, "-X", "utf8", *sys.orig_argv[1:]])  # noqa: S606


def _fail(*lines: str) -> int:
    from pebble.config.visible import shown

    with suppress(OSError):  # nowhere to write it to
        for line in lines:
            sys.stderr.write(f"pebble: {shown(line)}\n")
    return 1


def _flushes(stream: TextIO) -> bool:
    """True if the buffer was written. Otherwise it is discarded: Python would try to write it again at its exit."""
    try:
        stream.flush()
    except OSError:
        from pebble.runtime.output import discard_output

        discard_output(stream)
        return False
    return True


def _open_missing_streams() -> None:
    """Open /dev/null for each standard stream that the caller has closed (``pebble up robot.json >&-``)."""
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            descriptor = os.open(os.devnull, os.O_RDWR)  # the lowest free one: that of this stream
            os.set_inheritable(descriptor, True)
            # closefd: a forked child puts a pipe at this number and drops the stream, which must not close the pipe.
            setattr(sys, name, os.fdopen(descriptor, mode, encoding="utf-8", closefd=False))


def _accept_signals() -> None:
    """Let SIGTERM end this program, and its children be waited for, if the caller has blocked or ignored signals."""
    if hasattr(signal, "pthread_sigmask"):  # not on Windows
        signal.pthread_sigmask(signal.SIG_SETMASK, ())
        for number in (signal.SIGTERM, signal.SIGCHLD):
            if signal.getsignal(number) is signal.SIG_IGN:
                signal.signal(number, signal.SIG_DFL)


def _without_secrets(text: str) -> str:
    from pebble.config.secret_text import without_secrets  # of use to errors only

    return without_secrets(text)


def _print_error(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    """Print a traceback as Python does, but without secrets, which may come from the command line."""
    from traceback import format_exception

    sys.stderr.write(_without_secrets("".join(format_exception(kind, error, trace))))


def _run(arguments: list[str]) -> int:
    if len(arguments) == 2 and arguments[0] == "up" and not arguments[1].startswith("-"):
        gc.disable()  # until the programs' modules are imported: that takes a tenth less time without it
        from pebble.config import load  # without typer: this process becomes the launcher, which stays in memory
        from pebble.launcher.launcher import Launcher

        return Launcher(load(Path(arguments[1]), lenient=True)).run()
    from pebble.commands import app

    return app.run(arguments)


if __name__ == "__main__":
    sys.exit(main())
