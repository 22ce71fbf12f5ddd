"""A program of this machine, run until it ends."""

import os
import subprocess
import time
from collections.abc import Sequence
from contextlib import suppress
from typing import IO, Any, NamedTuple

_POLL_S = 0.01
_CHUNK, _CHUNKS = 65_536, 64  # read in one go: more than a pipe holds
_LONGEST = 8 << 20  # bytes of output, the last ones, that are kept


class Finished(NamedTuple):
    """The end of a program: its exit code, and the last part of its output."""

    code: int
    output: str
    errors: str  # empty if they are in ``output``


def run(command: Sequence[str], timeout_s: float, *, stderr: int = subprocess.PIPE, **options: Any) -> Finished:
    """Run a program until it ends, even if children that it leaves behind keep its output open.

    ``options``: more options of subprocess. Raises OSError and, after killing the program, subprocess.TimeoutExpired.
    """
    deadline, nothing = time.monotonic() + timeout_s, subprocess.DEVNULL
    with subprocess.Popen(command, stdin=nothing, stdout=subprocess.PIPE, stderr=stderr, **options) as process:
        pipes = [pipe for pipe in (process.stdout, process.stderr) if pipe is not None]
        for pipe in pipes:
            os.set_blocking(pipe.fileno(), False)
        texts, code = [b""] * len(pipes), None
        while code is None:
            if time.monotonic() >= deadline:
                process.kill()
                raise subprocess.TimeoutExpired(command, timeout_s)
            time.sleep(_POLL_S)
            code = process.poll()  # before its output is read: that is all of it then
            texts = [(text + _available(pipe))[-_LONGEST:] for text, pipe in zip(texts, pipes, strict=True)]
    output, errors = (*(text.decode(errors="replace") for text in texts), "")[:2]
    return Finished(code, output, errors)


def _available(pipe: IO[bytes]) -> bytes:
    data = b""
    with suppress(BlockingIOError):
        for _ in range(_CHUNKS):
            data += os.read(pipe.fileno(), _CHUNK)
    return data
