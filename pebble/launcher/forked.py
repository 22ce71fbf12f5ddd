"""The first and last steps of a child: how a forked copy of the launcher becomes one of the robot's programs."""

from __future__ import annotations

import atexit
import ctypes
import fcntl
import logging
import os
import runpy
import signal
import sys
import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import NoReturn

from pebble.config import Config, hand_over
from pebble.extension import Program, part
from pebble.runtime.parent import NOTIFY_FD, die_with_launcher
from pebble.runtime.process import run

_NOTES = 3  # the descriptor of notes, next after stdin, stdout and stderr
_PR_SET_NAME, _NAME_BYTES = 15, 15
_SIGNALS = signal.valid_signals()  # each call would make another set


def become(
    program: Program, environment: Mapping[str, str], config: Config, *, stdin: int, output: int, notes: int
) -> NoReturn:
    """Run ``program`` with these descriptors and no others, and exit with its code. Call this right after the fork.

    The program gets ``config`` as the launcher read it: the file may have changed since. All signals must be blocked.
    Never return or raise: the callers' frames belong to the launcher, and unwinding them would close descriptors whose
    numbers the child uses for other things.
    """
    code = 1

    def begin() -> None:
        with suppress(PermissionError):  # a container's filter: then Ctrl-C in a terminal reaches this process, too
            os.setpgid(0, 0)
        _arrange_descriptors(stdin, output, notes)
        _reset_signals()
        _forget_launcher({**environment, NOTIFY_FD: str(_NOTES)})  # this becomes the child's environment
        hand_over(config)
        _run(program)

    try:
        code = _run_to_exit_code(begin)
        _run_to_exit_code(_finish)
    finally:
        os._exit(code)


def _arrange_descriptors(stdin: int, output: int, notes: int) -> None:
    """Set the child's standard descriptors and notes, and close all others, such as the launcher's lock."""
    wanted = (stdin, output, output, notes)
    out_of_the_way = [fcntl.fcntl(descriptor, fcntl.F_DUPFD_CLOEXEC, len(wanted)) for descriptor in wanted]
    for number, descriptor in enumerate(out_of_the_way):  # else dup2 might close one that is still wanted
        os.dup2(descriptor, number, inheritable=number != _NOTES)  # what a child starts in turn must not write to it
    for name in os.listdir("/proc/self/fd"):  # noqa: PTH208  (a Path for each is slower than the fork itself)
        if int(name) > _NOTES:
            with suppress(OSError):  # that of the listing itself
                os.close(int(name))
    sys.stdin = os.fdopen(0, encoding="utf-8", errors="replace", closefd=False)
    sys.stdout = os.fdopen(1, "w", buffering=1, encoding="utf-8", errors="backslashreplace", closefd=False)
    sys.stderr = os.fdopen(2, "w", buffering=1, encoding="utf-8", errors="backslashreplace", closefd=False)


def _reset_signals() -> None:
    """Set signals as in a fresh interpreter. Ignored signals (nohup) stay ignored."""
    signal.set_wakeup_fd(-1)
    for number in _SIGNALS:
        if callable(signal.getsignal(number)):
            signal.signal(number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_SETMASK, ())


def _forget_launcher(environment: Mapping[str, str]) -> None:
    """Remove the launcher's handlers and variables. Change only what differs: a written page is no longer shared."""
    atexit._clear()
    logging.getLogger().handlers.clear()
    for name in os.environ.keys() - environment.keys():
        del os.environ[name]
    for name, value in environment.items():
        if os.environ.get(name) != value:
            os.environ[name] = value


def _run(program: Program) -> None:
    die_with_launcher()
    ctypes.CDLL(None).prctl(_PR_SET_NAME, program.name.encode()[:_NAME_BYTES])  # ps and top show it
    sys.argv = [program.module, *program.arguments]
    if ":" in program.module:  # module:function
        sys.exit(run(part(program.module)))
    if not hasattr(sys.modules.get(program.module), "__path__"):  # a module: of a package, run_module runs __main__
        sys.modules.pop(program.module, None)  # it was imported before the fork; python -m has it only as __main__
    runpy.run_module(program.module, run_name="__main__", alter_sys=True)


def _finish() -> None:
    """Run the interpreter's exit steps, but leave the launcher's objects as they are."""
    threading._shutdown()  # type: ignore[attr-defined]
    atexit._run_exitfuncs()
    sys.stdout.flush()
    sys.stderr.flush()


def _run_to_exit_code(job: Callable[[], None]) -> int:
    try:
        job()
    except SystemExit as end:
        if end.code is None or isinstance(end.code, int):
            return (end.code or 0) & 0xFF
        sys.stderr.write(f"{end.code}\n")
        return 1
    except BaseException:  # noqa: BLE001  (the process boundary; this writes the traceback)
        sys.excepthook(*sys.exc_info())
        return 1
    return 0
