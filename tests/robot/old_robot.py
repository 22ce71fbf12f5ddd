"""Old robots beside a new one under one emergency stop: ``python -m tests.robot.old_robot``.

The old ones are this project at an earlier commit, in a git worktree of its own: two Linux robots on MQTT and on Zenoh
with their simulated MCU, and a MiniLAMP with its firmware. All are driven by one client on one remote broker when
``pebble estop --all`` begins. Prints how soon each robot's wheels stop, and how often each message arrived at each
broker. It is not part of ``make test``, because it needs the project's history.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from pebble.simulation.trace import read_trace
from tests.robot.operator import Driver, Operator
from tests.support import ROOT, Broker, Child, until

OLD = "456f31d"  # the newest commit without emergency stops
FORWARD = {"x": 0, "z": 0.5}
SECONDS = 6.0  # of the stop
AT_ONCE_S = 0.4  # less than every dead-man's switch: a robot that takes longer was not stopped by a zero

STOP, DRIVE, SCRIPT = "incoming/estop", "incoming/drive-values", "incoming/autonomy-command"


class Robot:
    """A robot of the project in ``tree``, below the base ``pebble/robots/{name}``; what it starts ends with it."""

    old = True

    def __init__(self, name: str, tree: Path, folder: Path) -> None:
        self.name, self.tree = name, tree
        self.folder = folder / name
        self.folder.mkdir()
        self.trace = self.folder / "trace.jsonl"
        self._children: list[Child] = []

    def run(self, *arguments: str) -> None:
        with (self.folder / "log").open("ab") as log:
            self._children.append(
                Child(
                    [sys.executable, "-m", *arguments],
                    cwd=self.tree,
                    env={**os.environ, "PYTHONPATH": str(self.tree), "XDG_STATE_HOME": str(self.folder / "state")},
                    stdout=log,
                    stderr=log,
                )
            )  # fmt: skip

    def wheels(self) -> list[tuple[float, tuple[float, float]]]:
        """Every change of the motors, with its time (monotonic seconds)."""
        changes = read_trace(self.trace) if self.trace.exists() else []
        return [(entry.ns / 1e9, entry.motors) for entry in changes if entry.motors is not None]

    @property
    def moving(self) -> bool:
        wheels = self.wheels()
        return bool(wheels) and wheels[-1][1] != (0.0, 0.0)

    def close(self) -> None:
        for child in reversed(self._children):
            child.send_signal(signal.SIGTERM)
            child.wait(20)


class Linux(Robot):
    """A robot with a simulated Goob MCU at a pseudo terminal."""

    def __init__(self, name: str, tree: Path, folder: Path, remote: Broker, kind: str) -> None:
        super().__init__(name, tree, folder)
        self.local = Broker(self.folder) if kind == "mqtt" else None
        port = self.folder / "tty"
        board = ("pebble.simulation.mcu", "--kind", "goob") if self.old else ("pebble.cli", "sim", "goob")
        self.run(*board, "--link", str(port), "--trace", str(self.trace))
        assert until(port.exists), "the simulated MCU did not start"
        config = self.folder / "robot.json"
        config.write_text(json.dumps(self._config(kind, port, remote)))
        self.run("pebble.cli", "up", str(config))

    def _config(self, kind: str, port: Path, remote: Broker) -> dict[str, Any]:
        local = {} if self.local is None else {"local_mqtt": {"host": "127.0.0.1", "port": self.local.port}}
        return {
            "robot": {"id": self.name},
            "transport": {"kind": kind, "run_dir": str(self.folder / "run")},
            **local,
            "services": {
                "mqtt_bridge": {"enabled": True, "remote_mqtt": {"host": "127.0.0.1", "port": remote.port}},
                "serial_mcu_bridge": {"enabled": True, "serial": {"port": str(port), "baud": 460800}},
            },
        }

    def close(self) -> None:
        super().close()
        if self.local is not None:
            self.local.stop()


class New(Linux):
    """A robot of this tree."""

    old = False


class MiniLamp(Robot):
    """A robot that is an MCU, with the firmware of ``tree``."""

    def __init__(self, name: str, tree: Path, folder: Path, remote: Broker) -> None:
        super().__init__(name, tree, folder)
        self.run(
            "pebble.simulation.networked", "--kind", "minilamp", "--id", name,
            "--broker", f"127.0.0.1:{remote.port}", "--trace", str(self.trace),
        )  # fmt: skip


@contextmanager
def driven(operators: dict[str, Operator], sent: Counter[str]) -> Iterator[None]:
    """Send every robot forward, 10 times a second, and count what was sent."""
    drivers = {name: Driver(operator, 10.0, body=lambda _: FORWARD) for name, operator in operators.items()}
    try:
        yield
    finally:
        for name, driver in drivers.items():
            driver.stop()
            sent[name] += len(driver.sent_at)


def main() -> int:
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="pbl")))
        tree = folder / "old"
        subprocess.run(["git", "worktree", "add", "-q", "--detach", str(tree), OLD], cwd=ROOT, check=True)
        stack.callback(subprocess.run, ["git", "worktree", "remove", "--force", str(tree)], cwd=ROOT, check=True)
        remote = Broker(folder)
        stack.callback(remote.stop)
        robots: list[Robot] = []
        for make in (
            lambda: Linux("old-mqtt", tree, folder, remote, "mqtt"),
            lambda: Linux("old-zenoh", tree, folder, remote, "zenoh"),
            lambda: MiniLamp("old-lamp", tree, folder, remote),
            lambda: New("new-zenoh", ROOT, folder, remote, "zenoh"),
        ):
            robots.append(make())
            stack.callback(robots[-1].close)
        return _compare(stack, remote, robots)


def _compare(stack: ExitStack, remote: Broker, robots: list[Robot]) -> int:
    operators = {robot.name: _operator(stack, remote, robot) for robot in robots}
    assert until(lambda: all(one.last("outgoing/capabilities") for one in operators.values()), 60), "not all are up"
    local = {
        robot.name: _operator(stack, robot.local, robot)
        for robot in robots
        if isinstance(robot, Linux) and robot.local is not None
    }
    sent = Counter[str]()
    with driven(operators, sent):
        moving = until(lambda: all(robot.moving for robot in robots), 20)
    assert moving, [(robot.name, (robot.folder / "log").read_text()[-2000:]) for robot in robots if not robot.moving]
    began = time.monotonic()
    sender = Child(
        [sys.executable, "-m", "pebble.cli", "estop", "--all", "--url", f"mqtt://127.0.0.1:{remote.port}"],
        cwd=ROOT, stdout=subprocess.DEVNULL,
    )  # fmt: skip
    # The client drives on until the stop is sent: else the dead-man's switches would stop the wheels first.
    with driven(operators, sent):
        assert until(lambda: all(_zeros(one, began) for one in operators.values()), 10), "the stop is not sent"
    time.sleep(SECONDS)
    sender.send_signal(signal.SIGINT)
    sender.wait(10)
    time.sleep(1)  # what circulates would go on
    rows, failures = [], 0
    for robot in robots:
        row, right = _judge(robot, operators[robot.name], local.get(robot.name), sent[robot.name], began)
        rows.append(row)
        failures += not right
    _print(rows)
    return min(failures, 1)


def _operator(stack: ExitStack, broker: Broker, robot: Robot) -> Operator:
    operator = Operator(broker.port, f"pebble/robots/{robot.name}")
    stack.callback(operator.close)
    return operator


def _zeros(operator: Operator, since: float) -> list[float]:
    """When each of the sender's zeros arrived at the broker."""
    return [seen.at for seen in operator.on(DRIVE, since) if not seen.json.get("z")]


def _judge(
    robot: Robot, remote: Operator, local: Operator | None, driven: int, began: float
) -> tuple[dict[str, str], bool]:
    zeros = _zeros(remote, began)
    counts = {suffix: len(remote.on(suffix)) for suffix in (STOP, SCRIPT, DRIVE)}
    stopped = next((at for at, wheels in robot.wheels() if at >= zeros[0] - 0.1 and wheels == (0.0, 0.0)), None)
    at_rest = [wheels for at, wheels in robot.wheels() if at > zeros[0] + AT_ONCE_S and wheels != (0.0, 0.0)]
    commands = counts[DRIVE] - len(zeros)
    inside = len(local.on(DRIVE)) if local is not None else None
    right = (
        stopped is not None
        and stopped - zeros[0] < AT_ONCE_S
        and not at_rest
        and not robot.moving
        and commands == driven
        and inside in (None, counts[DRIVE])
        and len(zeros) <= SECONDS / 0.5 + 4
        and counts[SCRIPT] == (1 if robot.old else 0)
    )
    row = {
        "robot": robot.name,
        "wheels stop after": "never" if stopped is None else f"{(stopped - zeros[0]) * 1000:.0f} ms",
        "turn again": str(len(at_rest)),
        "stops": str(counts[STOP]),
        "zeros": str(len(zeros)),
        "script stops": str(counts[SCRIPT]),
        "drive sent / remote / local": f"{driven} / {commands} / {'-' if inside is None else inside - len(zeros)}",
        "": "as expected" if right else "WRONG",
    }
    return row, right


def _print(rows: list[dict[str, str]]) -> None:
    table = [list(rows[0]), *(list(row.values()) for row in rows)]
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    for line in table:
        sys.stdout.write("  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip() + "\n")


if __name__ == "__main__":
    sys.exit(main())
