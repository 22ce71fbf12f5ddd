"""Two motor owners in virtual time: random schedules of drivers, scripts, stops and faults, and tables of who drives.

``python -m tests.kit.schedules services`` runs thousands.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from pebble.config import Config
from tests.robot.lockstep.drivers import STRANGER
from tests.robot.lockstep.two_owners import ENGINE, FIRST, SECOND, TwoOwners, configuration
from tests.support import cases

pytestmark = [pytest.mark.computing, pytest.mark.usefixtures("quiet")]


def test_no_schedule_violates_a_rule() -> None:
    violated = [rule for result in ENGINE.run("", 1, range(cases(80, 300))) for rule in result.problems]
    assert not violated, "python -m tests.kit.schedules services --seed 1 prints the shortest schedule"


# -- histories of two owners


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory) -> Config:
    return configuration(Path(tmp_path_factory.mktemp("own")), "free")


@pytest.fixture(scope="module")
def bridged(tmp_path_factory: pytest.TempPathFactory) -> Config:
    return configuration(Path(tmp_path_factory.mktemp("own")), "free", bridged=True)


def perform(config: Config, events: tuple[Any, ...]) -> TwoOwners:
    """``(seconds, who or which owner, what, ...)``.

    ``(seconds, "moved by", first, second)`` and ``(seconds, "held by", who)`` are what must be then.
    """
    world = TwoOwners(0, (config,))
    begun = world.scheduler.now
    for at, who, what, *rest in sorted(events, key=lambda event: event[0]):
        world.scheduler.run(begun + at - world.scheduler.now)
        arguments = [argument for argument in rest if not isinstance(argument, dict)]
        fields = next((argument for argument in rest if isinstance(argument, dict)), {})
        if who == "moved by":
            assert [world.driver_of(name) for name in world.owners] == [what, *rest], f"after {at} s"
        elif who == "held by":
            assert world.holder == what, f"after {at} s"
        elif what == "frozen":
            world.freeze(world.owners[who], *rest)
        elif what == "killed":
            world.owners[who].kill(*rest)
        elif what == "retained":
            world.do_retain(1, -1)  # the newest turn, with a time of now
        else:
            others = {"broker": world.outside, "bridge": world.bridge, FIRST: world.owners[FIRST].connection}
            getattr(others.get(who) or world.drivers[who], what)(*arguments, **fields)
    return world


TAKE: dict[str, Any] = {"take": True}
ANN_DRIVES = ((0, "ann", "hold", 3000, TAKE), (0.1, "ann", "steer", 20))
EVE_TAKES_OVER = ((1.0, "eve", "hold", 3000, TAKE), (1.1, "eve", "steer", 20))
EVE_ASKS = (0.5, "eve", "hold", 10_000, {"period_s": 0.02})

#: By name: what happens, and who must move the first and the second owner when.
MEMBERS: dict[str, tuple[Any, ...]] = {
    "the second is frozen for five seconds, and control passes on meanwhile": (
        *(*ANN_DRIVES, (0.9, SECOND, "frozen", 5.0), *EVE_TAKES_OVER),
        *((1.5, "moved by", "", "ann"), (2.7, "moved by", "eve", ""), (6.5, "moved by", "eve", "eve")),
    ),
    "the first restarts while a driver without control asks 50 times a second": (
        *(*ANN_DRIVES, EVE_ASKS, (1.0, FIRST, "killed", 0.5), (1.6, "eve", "steer", 20)),
        *((at, "moved by", "eve", "eve") for at in (2.5, 4.0, 7.0)),
    ),
    "the first is dead": (
        *(*ANN_DRIVES, (1.0, FIRST, "killed", None), (1.9, "moved by", "", "ann"), (2.6, "moved by", "", "")),
        *((3.0, STRANGER, "steer", 20, ""), (3.0, "eve", "hold", 3000, TAKE), (3.1, "eve", "steer", 20)),
        (8.0, "moved by", "", ""),
    ),
    "the second is dead": (
        *(*ANN_DRIVES, (0.9, SECOND, "killed", None), *EVE_TAKES_OVER),
        *((2.5, "moved by", "", ""), (2.8, "moved by", "eve", ""), (5.0, "moved by", "eve", "")),
    ),
    "a retained turn of before the machine was started": (
        *(*ANN_DRIVES, (1.0, FIRST, "killed", None), (3.0, "ann", "retained"), (3.0, SECOND, "killed", 0.1)),
        *((4.0, "moved by", "", ""), (4.5, "moved by", "", "")),
    ),
    "a command without a key, while control is held": (
        *((0, "ann", "hold"), (0.2, STRANGER, "steer", 20, ""), (1.0, "moved by", "", ""), (5.0, "moved by", "", "")),
    ),
    "a script": (
        *((1.5, STRANGER, "steer", 20, "", {"source": "autonomy", "run": 7}), (2.0, "moved by", "script", "script")),
        *((2.0, "ann", "hold"), (2.1, "ann", "steer", 1.0), (2.5, "moved by", "ann", "ann")),
    ),
    "anybody's zero at the second, whose first is dead": (
        *(*ANN_DRIVES, (0.5, FIRST, "killed", None), (1.3, "moved by", "", "ann")),
        *((1.32, "eve", "zero"), (1.33, "moved by", "", "")),
    ),
    "anybody's stop while the first waits": (
        *(*ANN_DRIVES, (0.9, SECOND, "frozen", 1.0), *EVE_TAKES_OVER, (1.5, STRANGER, "stop")),
        *((2.7, "moved by", "", ""), (4.0, "moved by", "", "")),
    ),
}  # fmt: skip


ANN_HOLDS = (0, "ann", "hold", 3000)
EVE_WAITS = (0.5, "eve", "hold")
LATE_S = 4.0

#: With a bridge: what holds up, or loses, the messages of who has control, and who has it when.
SILENCE: dict[str, tuple[Any, ...]] = {
    "a flood by a viewer": (
        *(ANN_HOLDS, (1.0, "broker", "flood", 9.0, LATE_S), *((at, "held by", "ann") for at in (5.0, 9.0, 14.0, 18.0))),
    ),
    "a flood without end, and another asks: 30 s": (
        *(ANN_HOLDS, EVE_WAITS, (1.0, "broker", "flood", 60.0, 2.5)),
        *((29.9, "held by", "ann"), (30.5, "held by", "eve")),
    ),
    "a bridge that restarts": (
        *(*ANN_DRIVES, EVE_WAITS, (1.0, "bridge", "kill", 7.0)),
        *((at, "held by", "ann") for at in (5.0, 7.5, 12.0)),
    ),
    "Wi-Fi lost for 31 s: 30": (
        *(ANN_HOLDS, (1.0, "bridge", "lose", 31.0, {"local": False}), (30.0, "held by", "ann"), (31.5, "held by", "")),
        (34.0, "held by", "ann"),
    ),
    "it is taken over at once all the same": (
        *(*ANN_DRIVES, (1.0, "bridge", "kill", 4.0), (6.5, "eve", "hold", 3000, TAKE), (6.6, "held by", "eve")),
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", SILENCE)
def test_what_is_no_silence(bridged: Config, name: str) -> None:
    perform(bridged, SILENCE[name])


@pytest.mark.parametrize("name", MEMBERS)
def test_who_drives_two_owners(config: Config, name: str) -> None:
    perform(config, MEMBERS[name])


def test_the_second_shows_what_the_first_does_under_its_own_boot(config: Config) -> None:
    world = perform(config, (*ANN_DRIVES, (0.5, "eve", "hold"), (1.0, "moved by", "ann", "ann")))
    first, second = (world.drivers["ann"].seen[name] for name in (FIRST, SECOND))
    shown = ("id", "by", "key", "device", "asks", "asks_id", "others", "named")
    assert [getattr(second, field) for field in shown] == [getattr(first, field) for field in shown]
    assert (first.by, first.asks, len(first.key)) == ("ann", "eve", 8)
    assert first.boot != second.boot
