"""The dead-man's switch in virtual time: random schedules of faults, and firmware with deliberate bugs.

Checked: motors are off at most 1.0 s after the last command that arrived; they follow the newest fresh command;
retained messages and nonsense never move them; no command moves them that left the broker more than 2.45 s ago (the
time in the broker's own queue is unknown); no turn of the loop blocks; after the faults the robot is online again
within 30 s and executes commands. While it is stopped nothing moves, also after a power cut once its state says that
this is saved; a script moves nothing while a person drives, nor ever again once it is barred; no command moves anything
for longer than it is valid.
"""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import pytest

from pebble.simulation.micropython.loader import firmware_root
from pebble.simulation.wireless import KINDS
from tests.firmware.drill import LIMIT_S, ONLINE, RESENT_S, START_S, Drill, ViolatedError
from tests.firmware.schedules import FAULTS, act, perform
from tests.support import cases, some

pytestmark = pytest.mark.computing

MIXED, SINGLE = cases(40, 700), cases(2, 30)  # schedules per robot; of each fault alone
FIRST_SINGLE = MUTATED = 700  # seeds of single faults begin here; within so many every deliberate bug shows


@dataclass(frozen=True)
class Mutation:
    """Replaces ``original`` in ``file`` by ``mutated``, or appends it; ``faults`` are those under which it shows."""

    file: str
    mutated: str
    original: str = ""
    faults: tuple[str, ...] | None = None
    kind: str = "minilamp"
    named: bool = False  # the board checks names

    def apply(self, root: Path) -> None:
        text = (root / self.file).read_text()
        assert not self.original or text.count(self.original) == 1, f"{self.file} has changed: adapt this mutation"
        (root / self.file).write_text(
            text.replace(self.original, self.mutated) if self.original else text + self.mutated
        )


_ROBOT, _SESSION, _LIMIT = "wifi/network_robot.py", "wifi/session.py", "_DRIVE_LIMIT_MS = const(900)"
MUTATIONS = {
    "no dead-man": Mutation(_ROBOT, "_DRIVE_LIMIT_MS = const(90000)", _LIMIT),
    "a slow dead-man": Mutation(_ROBOT, "_DRIVE_LIMIT_MS = const(1020)", _LIMIT),
    "a dead-man that any byte feeds": Mutation(
        _ROBOT,
        "self.session.read(now)\n        if self.session.connection._received == now: self.deadman._fed = now",
        "self.session.read(now)",
        ("quiet", "flood"),
    ),
    "ticks without their wrap": Mutation("common/deadman.py", "\n\ndef diff(later, earlier): return later - earlier\n"),
    "retained commands count": Mutation(
        "wifi/mqtt.py",
        "\n\n_take = Client.take\n\n\ndef take(self, *count):\n    kind = _take(self, *count)\n    self.retained = 0\n"
        "    return kind\n\n\nClient.take = take\n",
        faults=("retained", "quiet"),
    ),
    "silence is borne": Mutation(
        "wifi/connection.py",
        "\n\n_step = Connection.step\n\n\ndef step(self, now, wifi):\n    due = _step(self, now, wifi)\n"
        "    return '' if due == 'drop' and self.reason == 'silence' else due\n\n\nConnection.step = step\n",
        faults=("stale",),
    ),
    "the oldest command acts": Mutation(
        _ROBOT, "if limit_ms != REFUSED and not self._next:", "if limit_ms != REFUSED:", ("flood", "hole")
    ),
    "names are looked up by the port": Mutation(
        _ROBOT,
        "\n\nimport socket\n\n_step = NetworkRobot.step\n\n\ndef step(self):\n    _step(self)\n"
        "    if self.session.connection.state == 'resolving':\n        socket.getaddrinfo('broker.test', 1883)\n\n\n"
        "NetworkRobot.step = step\n",
    ),
    "NaN is a number": Mutation(
        "common/payload.py",
        "\n\n_parse = parse\n\n\ndef parse(raw):\n"
        "    return (0.0, 1.0, 1.0, 0, -1) if b'NaN' in bytes(raw) else _parse(raw)\n",
        faults=("flood",),
    ),
    "a message to the shield is not repeated": Mutation(
        "benjr/robot.py",
        "\n\n_refresh = Body.refresh\n\n\ndef refresh(self):\n    _refresh(self)\n    self._waiting = []\n\n\n"
        "Body.refresh = refresh\n",
        faults=("i2c", "i2c", "quiet"),
        kind="benjr",
    ),
    "a stop that is ignored": Mutation(
        "common/latch.py", "            return False\n", "            return moves\n", ("stops",)
    ),
    "a reset without its count": Mutation(
        "common/latch.py", '"count" if False', '"count" if count != self.count', ("stops",)
    ),
    "a stop that is not saved": Mutation("common/estop.py", "pass", "os.rename(_NEW, _FILE)", ("stops", "power")),
    "limits are ignored": Mutation(
        _ROBOT, "_limit_ms = limit_ms and _DRIVE_LIMIT_MS", "_limit_ms = limit_ms", ("limits",)
    ),
    "a script that resumes": Mutation(
        "common/arbiter.py", "or False:", "or (run > 0 and not newer(run, self.barred)):", ("script",)
    ),
    "a script beside a person": Mutation(
        "common/arbiter.py", "elif self._starting", "elif self._held or self._starting", ("script",)
    ),
    "only the last command of a batch is judged": Mutation(
        _ROBOT,
        "\n\n_judge, _read = NetworkRobot._judge, Session.read\n\n\ndef judge(self, raw, by, now):\n"
        "    self._last = None if raw is None else bytes(raw)\n\n\ndef read(self, now):\n"
        "    robot = self._take.__self__\n    robot._last = b'-'\n    _read(self, now)\n"
        "    if robot._last != b'-':\n        _judge(robot, robot._last, '', now)\n\n\n"
        "NetworkRobot._judge, Session.read = judge, read\n",
        faults=("script",),
    ),
    "names do not count": Mutation(
        "wifi/mqtt.py", 'self.by = "ann"', "self.by = bytes(data[at:first]).decode()", ("control",), named=True
    ),
    "without a name one is whoever has control": Mutation(
        _ROBOT, 'by or (stops.lease.holder or [""])[0]', 'by or ("-" if stops.names else "")', ("control",), named=True
    ),
    "more writes than lwIP takes": Mutation(
        _SESSION, "_IN_FLIGHT = const(70)", "_IN_FLIGHT = const(7)", ("hole", "hole"), kind="benjr"
    ),
}


@pytest.mark.parametrize("kind", KINDS)
def test_motors_obey_the_newest_fresh_command_and_stop_without_one(kind: str) -> None:
    drills = [_performed(kind, seed) for seed in range(MIXED)]
    assert max(drill.seen.longest_run for drill in drills) <= LIMIT_S
    assert sum(drill.seen.moves for drill in drills) > 10 * MIXED  # they were driven indeed
    assert (
        sum(drill.robot.deadman.trips for drill in drills) > MIXED // 2
    )  # and often stopped by the dead-man's switch only
    assert sum(drill.robot.refused for drill in drills) > MIXED
    assert sum(drill.robot.stops.latch.count for drill in drills) > MIXED // 10
    assert sum(drill.robot.stops.arbiter.barred > 0 for drill in drills) >= MIXED // 20


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("kind", KINDS)
def test_each_fault_alone(kind: str, fault: str) -> None:
    for seed in range(SINGLE):
        _performed(kind, FIRST_SINGLE + seed, fault)


@pytest.mark.parametrize("name", some(MUTATIONS, 3))
def test_mutated_firmware_violates_the_rule(tmp_path: Path, name: str) -> None:
    mutation, root = MUTATIONS[name], tmp_path / "firmware"
    shutil.copytree(firmware_root(), root)
    mutation.apply(root)
    with pytest.raises(ViolatedError):
        _perform_all(mutation, root)


def _perform_all(mutation: Mutation, root: Path) -> None:
    for seed in range(MUTATED):
        perform(Drill(mutation.kind, seed, root=root, named=mutation.named), mutation.faults)


def _performed(kind: str, seed: int, *faults: str) -> Drill:
    drill = Drill(kind, seed, named=seed % 2 == 1)
    try:
        perform(drill, *([faults] if faults else []))
    except ViolatedError as error:
        raise ViolatedError(f"{kind}, seed {seed}, {faults or 'mixed faults'}: {error}") from None
    return drill


@pytest.mark.parametrize("fault", some(["flood", "quiet", "ntp", "i2c"], 2))
@pytest.mark.parametrize("kind", KINDS)
def test_the_heartbeat_continues(kind: str, fault: str) -> None:
    """Four times a second, whatever happens beside it, and stamped by a clock that never goes back."""
    for seed in range(cases(4, 10)):
        drill = Drill(kind, seed)
        act(drill, (fault,))
        received = [one for one in drill.broker.received if one.message.topic == ONLINE and one.at > START_S + 5.0]
        times = [one.at for one in received]
        assert (times[-1] - times[0]) / (len(times) - 1) == pytest.approx(0.25, rel=0.1)
        assert max(later - earlier for earlier, later in pairwise(times)) < 0.25 + 2 * RESENT_S
        stamps = [json.loads(one.message.payload)["t"] for one in received]
        assert all(later > earlier for earlier, later in pairwise(stamps))
