"""Whether robots notice a recorder: their heartbeats with one and without, in turns.

``python -m tests.recordings.heartbeats --rounds 6``. Four robots of the demo are driven and watched meanwhile.
"""

from __future__ import annotations

import argparse
import itertools
import random
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from pebble.bench.results import percentile
from pebble.contract import ONLINE
from pebble.rig.testbed import ROBOTS, Stage
from pebble.transports import Message, MqttSettings, QoS, create
from tests.recordings.endurance import Operator
from tests.support import until

_SLICE_S, _PERIOD_S = 20.0, 0.05


@contextmanager
def recorder(port: int) -> Iterator[None]:
    """One that runs, and is subscribed."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "pebble.cli", "record", "--url", f"mqtt://127.0.0.1:{port}", "--into", folder]
        running = subprocess.Popen(command, stdout=subprocess.DEVNULL)
        try:
            assert until(Path(folder, "recorder.json").exists, 30), "the recorder did not start"
            yield
        finally:
            running.send_signal(signal.SIGTERM)
            running.wait(20)


class Heartbeats:
    """When each robot's heartbeats arrived."""

    def __init__(self, port: int) -> None:
        self.at: dict[str, list[float]] = defaultdict(list)
        self.transport = create("mqtt", "heartbeats", MqttSettings(host="127.0.0.1", port=port))
        self.transport.open()
        self.transport.subscribe(f"+/+/+/{ONLINE.suffix}", self._receive, qos=QoS.DELIVERED, direct=True)

    def _receive(self, message: Message) -> None:
        self.at[message.topic].append(time.monotonic())

    def intervals_ms(self, operator: Operator) -> list[float]:
        """The heartbeats of the next slice, all robots together."""
        self.at.clear()
        end = time.monotonic() + _SLICE_S
        while time.monotonic() < end:
            operator.step()
            time.sleep(_PERIOD_S)
        found = [list(times) for times in self.at.values()]
        return [1000 * (after - before) for times in found for before, after in itertools.pairwise(times)]


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.recordings.heartbeats", description=__doc__)
    parser.add_argument("--rounds", type=int, default=6)
    rounds = parser.parse_args().rounds
    found: dict[str, list[float]] = {"without": [], "with": []}
    with Stage() as stage:
        heartbeats = Heartbeats(stage.broker_port)
        operator = Operator(stage.broker_port, [stage.ref(name) for name in ROBOTS])
        for number in range(rounds):
            for name in random.sample(sorted(found), 2):
                if name == "with":
                    with recorder(stage.broker_port):
                        intervals = heartbeats.intervals_ms(operator)
                else:
                    intervals = heartbeats.intervals_ms(operator)
                found[name].append(percentile(intervals, 99))
                sys.stdout.write(f"round {number + 1}, {name}: p99 {found[name][-1]:.1f} ms of {len(intervals)}\n")
                sys.stdout.flush()
        operator.close()
        heartbeats.transport.close()
    ratios = sorted(one / other for one, other in zip(found["with"], found["without"], strict=True))
    sys.stdout.write(
        f"heartbeat interval p99, median of {rounds} rounds: with {statistics.median(found['with']):.1f} ms, without "
        f"{statistics.median(found['without']):.1f} ms; ratio of the rounds {ratios[0]:.2f} to {ratios[-1]:.2f}, "
        f"median {statistics.median(ratios):.2f}\n"
    )


if __name__ == "__main__":
    main()
