"""A program of this machine, run until it ends."""

import os
import subprocess
from collections.abc import Sequence
from tempfile import TemporaryFile
from typing import IO, Any, NamedTuple

_LONGEST = 8 << 20  # bytes of output, the last ones, that are returned


class Finished(NamedTuple):
    """The end of a program: its exit code, and the last part of its output."""

    code: int
    output: str
    errors: str  # empty if they are in ``output``


def run(command: Sequence[str], timeout_s: float, *, stderr: int | None = None, **options: Any) -> Finished:
    """Run a program until it ends, even if children that it leaves behind keep its output open.

    ``stderr``: as for subprocess, such as STDOUT; None: into ``errors``. ``options``: more options of subprocess.
    Raises OSError and, after killing the program, subprocess.TimeoutExpired.
    """
    nothing = subprocess.DEVNULL
    with _file() as output, _file() as errors:
        to = errors if stderr is None else stderr
        done = subprocess.run(
            command, stdin=nothing, stdout=output, stderr=to, timeout=timeout_s, check=False, **options
        )
        return Finished(done.returncode, _last_part(output), _last_part(errors))


def _file() -> IO[bytes]:
    """Return a file in memory, where the system has such: the disk may be full."""
    return os.fdopen(os.memfd_create("output"), "w+b") if hasattr(os, "memfd_create") else TemporaryFile()


def _last_part(file: IO[bytes]) -> str:
    file.seek(max(0, file.seek(0, os.SEEK_END) - _LONGEST))
    return file.read().decode(errors="replace")
