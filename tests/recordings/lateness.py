"""How late the messages of a replay are, through a real mosquitto: ``python -m tests.recordings.lateness``."""

from __future__ import annotations

import resource
import sys
import tempfile
import time
from pathlib import Path

from pebble.bench.results import percentile
from pebble.recordings.replay.player import Player
from pebble.recordings.replay.robots import ReplayedRobots
from pebble.recordings.replay.rules import Options, Rules
from pebble.recordings.replay.source import ReplaySource
from pebble.transports import Message, MqttSettings, Transport, create
from tests.recordings.playing import demo, write
from tests.support import Broker

ROBOTS = tuple(f"pebble/robots/r{number}" for number in range(4))
SPEEDS = ((1.0, 20), (10.0, 120), (100.0, 300))  # and seconds of the recording


def lateness(path: Path, port: int, speed: float) -> tuple[list[float], float]:
    """The lateness of each message against the pace since the first one, ms; and the CPU time, seconds."""

    def make(name: str, will: Message | None) -> Transport:
        return create("mqtt", name.replace("/", "-"), MqttSettings(host="127.0.0.1", port=port), will=will)

    source = ReplaySource([path])
    rules = Rules(Options(incoming=True), source.channels)
    clocks = {"now": time.monotonic, "wait": time.sleep}
    late: list[float] = []
    with ReplayedRobots(make, rules.robots, wall_ms=lambda: time.time_ns() // 10**6, **clocks) as robots:  # type: ignore[arg-type]

        def publish(message: Message) -> bool:
            accepted = robots.publish(message)
            if accepted:
                late.append(1000 * player.late_s)
            return accepted

        player = Player(source, rules, publish, wall_ns=time.time_ns, speed=speed, **clocks)  # type: ignore[arg-type]
        before = resource.getrusage(resource.RUSAGE_SELF)
        player.run()
        after = resource.getrusage(resource.RUSAGE_SELF)
    return late, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        broker = Broker(Path(folder), "max_queued_messages 0")
        for speed, seconds in SPEEDS:
            path = write(Path(folder) / "demo.mcap", demo(seconds, ROBOTS))
            late, cpu = lateness(path, broker.port, speed)
            p50, p99 = percentile(late, 50), percentile(late, 99)
            share = 100 * cpu * speed / seconds
            sys.stdout.write(
                f"x {speed:g}: {len(late)} messages, late p50 {p50:.2f} p99 {p99:.2f} max {max(late):.1f} ms, "
                f"{share:.0f} % of a core\n"
            )
        broker.stop()


if __name__ == "__main__":
    main()
