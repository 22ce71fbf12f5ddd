"""Processes of tests that begin as forks of one that has imported their modules: importing is what takes time."""

from __future__ import annotations

import importlib
import multiprocessing
import os
import sys
import tempfile
from multiprocessing.reduction import DupFd
from typing import Any

from pebble.runtime.parent import end_with_parent

_context = multiprocessing.get_context("forkserver")
_context.set_forkserver_preload(
    [
        *("__main__", "tests.ext.media.frames.frames_peer", "tests.transports.net", "pebble.extensions.lab.rig.hub"),
        "tests.kit.robot",
    ]
)


class Forked:
    """Runs ``main(*arguments)`` of a module; its standard input and output are pipes, as a `Popen` has."""

    def __init__(self, module: str, *arguments: Any) -> None:
        their_input, our_output = os.pipe()
        our_input, their_output = os.pipe()
        self._errors = tempfile.TemporaryFile("w+")  # noqa: SIM115  (as long as the process)
        pipes = [DupFd(one) for one in (their_input, their_output, self._errors.fileno())]
        self._process = _context.Process(target=_run, args=(module, arguments, pipes), daemon=True)
        self._process.start()
        os.close(their_input)
        os.close(their_output)
        self.stdin, self.stdout = os.fdopen(our_output, "w"), os.fdopen(our_input)

    @property
    def pid(self) -> int:
        assert self._process.pid is not None
        return self._process.pid

    @property
    def printed(self) -> str:
        """What it has written to its standard error."""
        self._errors.seek(0)
        return self._errors.read()

    def poll(self) -> int | None:
        return self._process.exitcode

    def kill(self) -> None:
        self._process.kill()

    def wait(self, timeout: float) -> int | None:
        self._process.join(timeout)
        return self._process.exitcode


def _run(module: str, arguments: tuple[Any, ...], pipes: list[Any]) -> None:
    end_with_parent()
    for number, pipe in enumerate(pipes):
        os.dup2(pipe.detach(), number)
    sys.stdin, sys.stdout = os.fdopen(0, closefd=False), os.fdopen(1, "w", closefd=False)
    sys.exit(importlib.import_module(module).main(*arguments))
