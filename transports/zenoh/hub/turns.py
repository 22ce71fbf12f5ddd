"""The tasks of a hub's thread have an order, and what waits for it has room that is bounded."""

from __future__ import annotations

import threading
from collections import OrderedDict, deque
from collections.abc import Callable
from time import monotonic

QUEUE_LIMIT = 10_000  # tasks that wait, but for those that are asked for; beyond it their senders wait
REST = 4.0  # what is asked for pauses so many times as long as it took, if other tasks wait

Task = Callable[[], None]


class Turns:
    """Tasks for one thread. What is asked for comes after all else, but has a fifth of the time while both wait.

    Its kinds have their turns one after the other, and so have the names of each kind.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._changed, self._room = threading.Condition(self._lock), threading.Condition(self._lock)
        self._tasks, self._asked = deque[Task](), OrderedDict[str, OrderedDict[str, deque[Task]]]()
        self._ended = False
        self._is_asked, self._began, self._again = False, 0.0, 0.0  # of the task that was taken last

    def put(self, task: Task) -> None:
        """Wait for room."""
        with self._lock:
            while len(self._tasks) >= QUEUE_LIMIT:
                self._room.wait()
            self._tasks.append(task)
            self._changed.notify()

    def ask(self, kind: str, name: str, task: Task) -> None:
        """Queue what was asked for, without waiting: who asks has taken a place before."""
        with self._lock:
            self._asked.setdefault(kind, OrderedDict()).setdefault(name, deque()).append(task)
            self._changed.notify()

    def end(self) -> None:
        """Have :meth:`take` return None once no task is left."""
        with self._lock:
            self._ended = True
            self._changed.notify()

    def take(self, timeout: float | None) -> Task | None:
        """The next task, one that does nothing after ``timeout`` seconds; None at the end."""
        with self._lock:
            now = monotonic()
            if self._is_asked:
                self._is_asked, self._again = False, now + REST * (now - self._began)
            if not (self._tasks or self._asked or self._ended) and not self._changed.wait(timeout):
                return _nothing
            self._began = monotonic()
            if self._asked and (not self._tasks or self._began >= self._again):
                self._is_asked = True
                return self._next_asked()
            if self._tasks:
                self._room.notify()
                return self._tasks.popleft()
            return None if self._ended else _nothing

    def _next_asked(self) -> Task:
        kind, names = self._asked.popitem(last=False)
        name, tasks = names.popitem(last=False)
        task = tasks.popleft()
        if tasks:
            names[name] = tasks
        if names:
            self._asked[kind] = names
        return task


class Places:
    """Room for what waits, ``most`` for each name; beyond it ``senders`` of that name wait, and others are refused."""

    def __init__(self, most: int, senders: int = 0) -> None:
        self._most, self._senders = most, senders
        self.taken: dict[str, int] = {}  # places, by name
        self.outside: dict[str, int] = {}  # senders that wait, by name
        self._changed = threading.Condition()

    def take(self, name: str = "", size: int = 1) -> bool:
        """Whether there is room. What is larger than all of it has it to itself."""
        with self._changed:
            if self._is_full(name, size):
                if self.outside.get(name, 0) >= self._senders:
                    return False
                _add(self.outside, name, 1)
                self._changed.wait_for(lambda: not self._is_full(name, size))
                _add(self.outside, name, -1)
            _add(self.taken, name, size)
            return True

    def leave(self, name: str = "", size: int = 1) -> None:
        with self._changed:
            _add(self.taken, name, -size)
            if self.outside:
                self._changed.notify_all()

    def _is_full(self, name: str, size: int) -> bool:
        taken = self.taken.get(name, 0)
        return bool(taken) and taken + size > self._most


def _add(counts: dict[str, int], name: str, number: int) -> None:
    if (count := counts.get(name, 0) + number) > 0:
        counts[name] = count
    else:
        del counts[name]


def _nothing() -> None:
    """Time has passed."""
