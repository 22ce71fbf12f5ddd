"""The ``pebble`` command: turns errors into lines on stderr and an exit code.

0: success. 1: failure, or no result. 2: the command line is wrong. 130: Ctrl-C.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path
from types import TracebackType

from pebble.errors import PebbleError


def main() -> int:
    """The entry point; returns the exit code."""
    _open_missing_streams()
    sys.excepthook = _print_error
    try:
        code = _run(sys.argv[1:])
        sys.stdout.flush()
    except PebbleError as error:
        for line in _without_secrets(str(error)).splitlines():
            sys.stderr.write(f"pebble: {line}\n")
        return 1
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:  # the reader has ended (`pebble topics | head`)
        from pebble.commands.show import discard_output

        discard_output(sys.stdout)
        return 1
    return code


def _open_missing_streams() -> None:
    """Read from and write to nothing where the caller has closed a standard stream (``pebble up robot.json >&-``)."""
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            descriptor = os.open(os.devnull, os.O_RDWR)  # the lowest free one: that of this stream
            os.set_inheritable(descriptor, True)
            # As Python's own: it stays open when a child replaces the stream, and its descriptor by a pipe.
            setattr(sys, name, os.fdopen(descriptor, mode, encoding="utf-8", closefd=False))


def _without_secrets(text: str) -> str:
    from pebble.config.secret_text import without_secrets  # of use to errors only

    return without_secrets(text)


def _print_error(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    """As Python prints an error that is none of ours: what is in a traceback may come from a command line."""
    from traceback import format_exception

    sys.stderr.write(_without_secrets("".join(format_exception(kind, error, trace))))


def _run(arguments: list[str]) -> int:
    if len(arguments) == 2 and arguments[0] == "up" and not arguments[1].startswith("-"):
        from pebble.config import load  # without typer: this process becomes the launcher, which stays in memory
        from pebble.launcher.launcher import Launcher

        return Launcher(load(Path(arguments[1]))).run()
    from pebble.commands import app

    return app.run(arguments)


if __name__ == "__main__":
    sys.exit(main())
