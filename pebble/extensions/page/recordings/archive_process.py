"""The processes that read recordings for pages: one that answers at once, and one for each long job."""

import asyncio
import multiprocessing
import os
import signal
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnContext
from pathlib import Path
from typing import Any, Final, TypeVar

from pebble.errors import PebbleError
from pebble.extensions.recordings.seek import questions

MOST_WAITING: Final = 64  # questions
_END_S: Final = 2.0  # so long the end of a killed process is waited for
SILENT_S: Final = 300.0  # a job that has shown no sign of life for so long is ended

AnswerT = TypeVar("AnswerT")


def _spawn() -> SpawnContext:
    """Return a context for starting a process that imports nothing from the current folder."""
    os.environ["PYTHONSAFEPATH"] = "1"
    return multiprocessing.get_context("spawn")


class BusyError(PebbleError):
    """An error: too many questions at once."""


class ArchiveProcess:
    """A process that answers questions about one folder, one after another. The first question starts it."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._pool: ProcessPoolExecutor | None = None
        self._waiting = 0

    @property
    def pids(self) -> list[int]:
        """Return the id of the running process, if any."""
        return [] if self._pool is None else list(self._pool._processes or ())  # those of a pool are not public

    async def ask(self, question: Callable[..., AnswerT], *arguments: Any) -> AnswerT:
        """Return the answer of a function of :mod:`pebble.extensions.recordings.seek.questions`. Raises PebbleError."""
        if self._waiting >= MOST_WAITING:
            raise BusyError("too many questions about recordings at once: try again")
        self._waiting += 1
        try:
            return await asyncio.wrap_future(self._started().submit(question, *arguments))
        except BrokenProcessPool:
            self.close()
            raise PebbleError("the process that reads recordings has ended: try again") from None
        except (OSError, ImportError, MemoryError) as error:
            raise PebbleError(questions.reason(error)) from None
        finally:
            self._waiting -= 1

    def close(self) -> None:
        pool, self._pool = self._pool, None
        if pool is not None:
            processes = list((pool._processes or {}).values())  # those of a pool are not public
            pool.shutdown(wait=False, cancel_futures=True)
            for process in processes:
                process.kill()

    def _started(self) -> ProcessPoolExecutor:
        if self._pool is None:
            self._pool = ProcessPoolExecutor(
                1, mp_context=_spawn(), initializer=questions.begin, initargs=(self._folder,)
            )
        return self._pool


class Job:
    """A long job in a process of its own, which writes its result to a file."""

    def __init__(self, function: Callable[..., None], *arguments: Any) -> None:
        """Start the process. ``function`` takes a Connection, then ``arguments``. Call it on the event loop."""
        self.done = 0.0  # the share of the work
        self.ready = False
        self.why = ""  # it failed
        self.unread = ""  # it is ready, but this could not be read
        answers, job_end = multiprocessing.Pipe(duplex=False)
        self._process = _spawn().Process(target=function, args=(job_end, *arguments), daemon=True)
        try:
            self._process.start()
        except OSError as error:
            self.why = f"no process could be started: {error.strerror or error}"
        job_end.close()  # in this process; so ``answers`` ends when the job's process does
        self._task = asyncio.create_task(self._follow(answers))

    @property
    def running(self) -> bool:
        return not self._task.done()

    async def end(self) -> None:
        self._process.kill()
        await asyncio.gather(self._task, return_exceptions=True)

    async def _follow(self, answers: Connection) -> None:
        """Take the job's answers until it is ready, has failed, or is silent for too long; then end its process."""
        loop, readable = asyncio.get_running_loop(), asyncio.Event()
        loop.add_reader(answers.fileno(), readable.set)
        try:
            while not self.ready and not self.why:
                await asyncio.wait_for(readable.wait(), SILENT_S)
                readable.clear()
                while not self.ready and not self.why and answers.poll():
                    self._take(*answers.recv())  # it is short, and comes as a whole
        except EOFError:
            await asyncio.to_thread(self._process.join, _END_S)
            self.why = _ended(self._process.exitcode)
        except TimeoutError:
            self.why = f"it did nothing for {SILENT_S:.0f} s and was ended: look at the disk, then try again"
        finally:
            loop.remove_reader(answers.fileno())
            answers.close()
            if self._process.pid is not None:
                self._process.kill()
                await asyncio.to_thread(self._process.join, _END_S)

    def _take(self, what: str, value: Any) -> None:
        """Handle an answer of the job: its share of the work ("done"), its end, or why it failed."""
        if what == "done":
            self.done = value
        elif what == "ready":
            self.ready, self.unread = True, value
        else:
            self.why = value


def _ended(code: int | None) -> str:
    """Return why a process no longer answers, from its exit code."""
    if code == -signal.SIGKILL:
        return "its process was killed, as it is where memory runs out: end other programs, or choose less"
    return f"its process has ended ({code}): the log of the server says why"
