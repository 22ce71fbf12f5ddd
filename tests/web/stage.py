"""Whole robots and the page's server for tests with a browser: the truth is in the traces of the robots' motors.

``with Stage() as stage`` has the demo's four robots (4 s), ``with Stage("minilamp")`` only one (1.5 s).
"""

from __future__ import annotations

from pebble.rig import testbed
from pebble.simulation.trace import Entry


class Stage(testbed.Stage):
    """What only tests do with one, and what they look at."""

    def restart_broker(self) -> None:
        """Start the operators' broker again at the same port, without its retained messages. Raises PebbleError."""
        self.end(self.remote_broker)
        self.remote_broker = self.broker("remote-broker", port=self.broker_port)
        self.remote_broker.wait()

    def turned_s(self, name: str, since_ns: int) -> float:
        """How long its motors have run since then, in seconds."""
        return sum(max(0, end - max(since_ns, begin)) for begin, end in self.motions(name)) / 1e9

    def lines(self, name: str) -> list[Entry]:
        """What its MCU received, oldest first."""
        return [entry for entry in self.robots[name].entries() if entry.event == "line"]
