"""The dead-man in virtual time: random schedules of faults, and firmware that was spoilt on purpose.

What is shown: motors are off at most 1.0 s after the last command that arrived; what they do was asked for by the
newest fresh command; kept copies and nonsense never move; no command moves that left the broker more than 2.45 s ago
(how long it waited in the broker's own queue, nobody here can know); no turn of the loop waits; after the faults the
robot is online again within 30 s and obeys.
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

MIXED, SINGLE = 700, 30  # schedules per robot; of each fault alone


@dataclass(frozen=True)
class Mutation:
    """``whole`` in ``file`` becomes ``spoilt``, or ``spoilt`` is added at its end; ``faults`` under which it shows."""

    file: str
    spoilt: str
    whole: str = ""
    faults: tuple[str, ...] | None = None
    kind: str = "minilamp"

    def apply(self, root: Path) -> None:
        text = (root / self.file).read_text()
        assert not self.whole or text.count(self.whole) == 1, f"{self.file} has changed: what is to be spoilt there?"
        (root / self.file).write_text(text.replace(self.whole, self.spoilt) if self.whole else text + self.spoilt)


_ROBOT, _LIMIT = "common/network_robot.py", "_DRIVE_LIMIT_MS = const(900)"
MUTATIONS = {
    "no dead-man": Mutation(_ROBOT, "_DRIVE_LIMIT_MS = const(90000)", _LIMIT),
    "a slow dead-man": Mutation(_ROBOT, "_DRIVE_LIMIT_MS = const(1020)", _LIMIT),
    "a dead-man that any byte feeds": Mutation(
        _ROBOT, "self.link.heard(now); self._deadman._fed = now", "self.link.heard(now)", ("quiet", "flood")
    ),
    "ticks without their wrap": Mutation("common/deadman.py", "\n\ndef diff(later, earlier): return later - earlier\n"),
    "kept commands count": Mutation(
        "common/mqtt.py",
        "\n\n_take = Client.take\n\n\ndef take(self, *count):\n    kind = _take(self, *count)\n    self.retained = 0\n"
        "    return kind\n\n\nClient.take = take\n",
        faults=("kept", "quiet"),
    ),
    "silence is borne": Mutation(
        "common/link.py",
        "\n\n_step = Link.step\n\n\ndef step(self, now, wifi):\n    due = _step(self, now, wifi)\n"
        "    return '' if due == 'drop' and self.reason == 'silence' else due\n\n\nLink.step = step\n",
        faults=("stale",),
    ),
    "the oldest command acts": Mutation(
        _ROBOT, "axes = axes or self._take(count, now)", "axes = self._take(count, now) or axes", ("flood", "hole")
    ),
    "names are looked up by the port": Mutation(
        _ROBOT,
        "\n\nimport socket\n\n_step = NetworkRobot.step\n\n\ndef step(self):\n    _step(self)\n"
        "    if self.link.state == 'resolving':\n        socket.getaddrinfo('broker.test', 1883)\n\n\n"
        "NetworkRobot.step = step\n",
    ),
    "NaN is a number": Mutation(
        "common/payload.py",
        "\n\n_wanted = wanted\n\n\ndef wanted(raw):\n"
        "    return (0.0, 1.0, 1.0) if b'NaN' in bytes(raw) else _wanted(raw)\n",
        faults=("flood",),
    ),
    "the shield is told once": Mutation(
        "benjr/robot.py",
        "\n\n_keep = Body.keep\n\n\ndef keep(self):\n    _keep(self)\n    self._waiting = []\n\n\nBody.keep = keep\n",
        faults=("i2c", "i2c", "quiet"),
        kind="benjr",
    ),
    "more writes than lwIP takes": Mutation(
        _ROBOT, "_FLYING = const(70)", "_FLYING = const(7)", ("hole", "hole"), kind="benjr"
    ),
}


@pytest.mark.parametrize("kind", KINDS)
def test_motors_obey_the_newest_fresh_command_and_stop_without_one(kind: str) -> None:
    drills = [_performed(kind, seed) for seed in range(MIXED)]
    assert max(drill.seen.longest_run for drill in drills) <= LIMIT_S
    assert sum(drill.seen.moves for drill in drills) > 10 * MIXED  # they were driven indeed
    assert sum(drill.robot.trips for drill in drills) > MIXED // 2  # and often stopped by nobody else
    assert sum(drill.robot.refused for drill in drills) > MIXED


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("kind", KINDS)
def test_each_fault_alone(kind: str, fault: str) -> None:
    for seed in range(SINGLE):
        _performed(kind, MIXED + seed, fault)


@pytest.mark.parametrize("name", MUTATIONS)
def test_spoilt_firmware_is_noticed(tmp_path: Path, name: str) -> None:
    mutation, root = MUTATIONS[name], tmp_path / "firmware"
    shutil.copytree(firmware_root(), root)
    mutation.apply(root)
    with pytest.raises(ViolatedError):
        _perform_all(mutation, root)


def _perform_all(mutation: Mutation, root: Path) -> None:
    for seed in range(MIXED):
        perform(Drill(mutation.kind, seed, root=root), mutation.faults)


def _performed(kind: str, seed: int, *faults: str) -> Drill:
    drill = Drill(kind, seed)
    try:
        perform(drill, *([faults] if faults else []))
    except ViolatedError as error:
        raise ViolatedError(f"{kind}, seed {seed}, {faults or 'mixed faults'}: {error}") from None
    return drill


@pytest.mark.parametrize("fault", ["flood", "quiet", "ntp", "i2c"])
@pytest.mark.parametrize("kind", KINDS)
def test_the_heart_beats_on(kind: str, fault: str) -> None:
    """Four times a second, whatever happens beside it, and stamped by a clock that never goes back."""
    for seed in range(10):
        drill = Drill(kind, seed)
        act(drill, (fault,))
        heard = [one for one in drill.broker.heard if one.message.topic == ONLINE and one.at > START_S + 5.0]
        times = [one.at for one in heard]
        assert (times[-1] - times[0]) / (len(times) - 1) == pytest.approx(0.25, rel=0.1)
        assert max(later - earlier for earlier, later in pairwise(times)) < 0.25 + 2 * RESENT_S
        stamps = [json.loads(one.message.payload)["t"] for one in heard]
        assert all(later > earlier for earlier, later in pairwise(stamps))
