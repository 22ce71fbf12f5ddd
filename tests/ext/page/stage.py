"""Whole robots and the page's server for tests with a browser: the truth is in the traces of the robots' motors."""

from __future__ import annotations

import threading
import time

from pebble.contract.identity import Identity
from pebble.extensions.lab.rig.testbed import Testbed


class Stage(Testbed):
    """Brokers and the named robots, and the page's server; no operator drives them.

    ``robots``, by name, are traced: ``entries()`` is what each MCU received and did, with time.monotonic_ns().
    ``url`` of the page ends with a slash. Raises PebbleError.
    """

    keep = False

    def __init__(self, *names: str) -> None:
        super().__init__(threading.Event(), names)

    def start(self) -> None:
        self.start_brokers()
        self.start_page()
        self.start_robots()
        self.server.wait()
        self.url = self.server.url
        self.wait_until_ready()

    def ref(self, name: str) -> str:
        return Identity("pebble", "robots", name).base

    def motors(self, name: str) -> list[tuple[int, tuple[float, float]]]:
        """Every change of its motors, oldest first: monotonic ns, left and right."""
        return [(entry.ns, entry.motors) for entry in self.robots[name].entries() if entry.motors is not None]

    def motions(self, name: str) -> list[tuple[int, int]]:
        """From when until when its motors ran at the same speeds; now if they run."""
        changes = self.motors(name)
        ends = [*(ns for ns, _ in changes[1:]), time.monotonic_ns()]
        return [(ns, end) for (ns, speeds), end in zip(changes, ends, strict=False) if any(speeds)]

    def wheels_turning(self, name: str, since_ns: int) -> bool:
        """True if its motors have run at any time since ``since_ns``."""
        return any(end > since_ns for _, end in self.motions(name))
