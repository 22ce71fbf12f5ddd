"""The output of commands: as wide as the terminal; in a pipe not folded, and discarded if its reader has ended."""

from __future__ import annotations

import os
import sys
from typing import TYPE_CHECKING, TextIO

if TYPE_CHECKING:
    from rich.console import Console

_UNFOLDED = 10_000  # columns


def console() -> Console:
    """Return a console for tables. In a pipe, lines are neither folded nor cut, unless COLUMNS sets a width."""
    from rich.console import Console

    is_wide = not sys.stdout.isatty() and "COLUMNS" not in os.environ
    return Console(highlight=False, width=_UNFOLDED if is_wide else None)


def discard_output(stream: TextIO) -> None:
    """Discard further output to ``stream``: its reader has ended, or a disk is full."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
