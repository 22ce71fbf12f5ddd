"""The ``pebble`` command: turns errors into one line each and an exit code.

0: done. 1: it did not work, or what was asked for was not there. 2: the command line is wrong. 130: Ctrl-C.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

from pebble.errors import PebbleError


def main() -> int:
    """The entry point; returns the exit code."""
    try:
        code = _run(sys.argv[1:])
        sys.stdout.flush()
    except PebbleError as error:
        for line in str(error).splitlines():
            sys.stderr.write(f"pebble: {line}\n")
        return 1
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:  # the reader has gone (`pebble topics | head`): what is left to say goes nowhere
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    return code


def _run(arguments: list[str]) -> int:
    if len(arguments) == 2 and arguments[0] == "up" and not arguments[1].startswith("-"):
        from pebble.commands import robot  # without typer: the launcher stays in memory as long as the robot runs

        return robot.run(Path(arguments[1]))
    from pebble.commands import app

    return app.run(arguments)


if __name__ == "__main__":
    sys.exit(main())
