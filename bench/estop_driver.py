"""Drives robots at a steady rate, as a process: ``python -m pebble.bench.estop_driver PORT``.

Each line is the base topics of the robots to drive from now on, separated by spaces. Robots that begin or end to be
driven are sent a zero.
"""

from __future__ import annotations

import json
import sys
import threading
import time
from typing import Final

from pebble.contract import DRIVE
from pebble.rig.stock_client import MANY, StockClient
from pebble.rig.worker_end import serve

RATE_HZ: Final = 20.0  # of each robot
AHEAD: Final = json.dumps({"x": 0.0, "z": 0.5}).encode()
ZERO: Final = json.dumps({"x": 0.0, "z": 0.0}).encode()


class Driver(StockClient):
    """One MQTT connection. Commands are spread evenly over time, robot after robot."""

    def __init__(self, port: int) -> None:
        self._lock = threading.Lock()
        self._bases: tuple[str, ...] = ()
        super().__init__(in_flight=MANY)
        self.open(port)

    def choose(self, bases: tuple[str, ...]) -> None:
        """Drive these robots, and no others."""
        with self._lock:
            for base in {*self._bases} ^ {*bases}:
                self.send(DRIVE, base, ZERO)
            self._bases = bases

    def run(self) -> None:
        """Drive for ever."""
        number, due = 0, time.monotonic()
        while True:
            with self._lock:
                count = len(self._bases)
                if count:
                    self.send(DRIVE, self._bases[number % count], AHEAD)
            number += 1
            due = max(due + 1 / RATE_HZ / max(1, count), time.monotonic() - 1 / RATE_HZ)
            time.sleep(max(0.0, due - time.monotonic()))


def main(arguments: list[str]) -> int:
    driver = Driver(int(arguments[0]))
    threading.Thread(target=driver.run, name="driver", daemon=True).start()
    serve(lambda line: driver.choose(tuple(line.split())))
    driver.close()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
