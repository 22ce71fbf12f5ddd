"""Whole robots with the operator page and no scripted operator, for tests and measurements of the page."""

from __future__ import annotations

import threading
import time
from contextlib import closing
from typing import Any

from pebble.errors import PebbleError
from pebble.rig.operator import Operator
from pebble.rig.testbed import ROBOTS, PageServer, Testbed
from pebble.simulation.trace import Entry

_DRIVABLE_S = 30.0

_AT_REST = (0.0, 0.0)


class Stage(Testbed):
    """Brokers and the named robots (none: all four), and the page's server as a process of its own.

    ``robots``, by name, are traced: ``entries()`` is what each MCU received and did, with time.monotonic_ns().
    ``room``: Goob sees its room, in pictures as old as the room's state; else a scene that is drawn when due.
    ``settings`` are fields of WebSettings. A context manager, for the main thread. Raises PebbleError.
    """

    def __init__(self, *names: str, room: bool = True, **settings: Any) -> None:
        super().__init__(threading.Event(), names or ROBOTS, room=room)
        self.keep, self._settings = False, settings

    def start(self) -> None:
        self.start_brokers()
        self.start_page(**self._settings)
        self.start_robots()
        self.server.wait()
        with closing(Operator(self.broker_port, "stage")) as operator:
            operator.connect()
            operator.wait_until_ready(len(self.robots), _DRIVABLE_S, self.unexpected_exits)

    def __exit__(self, *_: object) -> None:
        if self.page is not None:
            self.page.thaw()
        super().__exit__()

    @property
    def server(self) -> PageServer:
        if self.page is None:
            raise PebbleError("the stage has not been entered")
        return self.page

    @property
    def url(self) -> str:
        """The address of the page, with a slash at the end."""
        return self.server.url

    def restart_server(self) -> None:
        """Start it again at the same address; ends the old one if it runs."""
        port = int(self.url.rpartition(":")[2].rstrip("/"))
        self.start_page(**{**self._settings, "port": port}).wait()

    def ref(self, name: str) -> str:
        return f"pebble/robots/{name}"

    def robot_url(self, name: str) -> str:
        return f"{self.url}r/{self.ref(name)}"

    # -- the motors

    def motors(self, name: str) -> list[tuple[int, tuple[float, float]]]:
        """Every change of its motors, oldest first: monotonic ns, left and right."""
        return [(entry.ns, entry.motors) for entry in self.robots[name].entries() if entry.motors is not None]

    def wheels_turning(self, name: str, since_ns: int | None = None) -> bool:
        """Whether its motors run now; with ``since_ns`` whether they have run at any time since then."""
        if since_ns is None:
            return [speeds for _, speeds in self.motors(name)][-1:] not in ([], [_AT_REST])
        return self.last_motion_ns(name) > since_ns

    def turned_s(self, name: str, since_ns: int) -> float:
        """How long its motors have run since then, in seconds."""
        return sum(max(0, end - max(since_ns, begin)) for begin, end in self._motions(name)) / 1e9

    def last_motion_ns(self, name: str) -> int:
        """When its motors were last switched off; now if they run, 0 if they have never run."""
        return max((end for _, end in self._motions(name)), default=0)

    def _motions(self, name: str) -> list[tuple[int, int]]:
        """From when until when its motors ran at the same speeds; now if they run."""
        changes = self.motors(name)
        ends = [*(ns for ns, _ in changes[1:]), time.monotonic_ns()]
        return [(ns, end) for (ns, speeds), end in zip(changes, ends, strict=False) if speeds != _AT_REST]

    def relays(self, name: str) -> list[str]:
        """Every change of its outlets' relays, oldest first: "o1 on"."""
        return [entry.line for entry in self.robots[name].relays()]

    def lines(self, name: str) -> list[Entry]:
        """What its MCU received, oldest first."""
        return [entry for entry in self.robots[name].entries() if entry.event == "line"]
