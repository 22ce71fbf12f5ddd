"""What can happen to a robot, its link and its brokers, each for some seconds."""

from __future__ import annotations

import random
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from tests.robot.soak.flood import FLOODS, flooding
from tests.robot.soak.world import World

_LINE_S = 0.85  # 0.75 s, and the time of a line
_MCU_S = 1.3  # where no process is left to send a zero, the MCU stops by itself


@dataclass(frozen=True)
class Attack:
    """``run`` returns when it is over. ``turns_s``: how long wheels may turn without another line."""

    run: Callable[[World, float], None]
    seconds: tuple[float, float]
    turns_s: float = _LINE_S


def _flood(name: str, world: World, seconds: float) -> None:
    with flooding(name, world.remote.port, seconds):
        pass


def _freeze(name: str, world: World, seconds: float) -> None:
    pids = {"robot": tuple(world.robot.values()), "remote broker": (world.remote.pid,)}
    if world.rig.local is not None:
        pids["local broker"] = (world.rig.local.pid,)
    chosen = pids.get(name) or (world.robot[name],)
    with world.still(*chosen):
        time.sleep(seconds)


def _kill(name: str, world: World, _seconds: float) -> None:
    if name == "local broker":
        world.rig.kill_local_broker()
    elif name == "launcher":
        world.rig.kill_launcher()
        world.start(ready=False)  # as systemd would
    else:
        world.rig.kill(name)


def _reconnects(world: World, seconds: float) -> None:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        world.rig.uplink.drop()
        time.sleep(0.3)


def _blackhole(world: World, seconds: float) -> None:
    world.rig.uplink.blackhole()
    time.sleep(seconds)
    world.rig.uplink.resume()


def _restore(world: World, _seconds: float) -> None:
    newer = world.save()
    world.restore()
    world.older = newer


def _fill(world: World, seconds: float, name: str = "") -> None:
    with world.full():
        if name:
            world.rig.kill(name)
        time.sleep(seconds)


def _jump(ahead_s: float, world: World, seconds: float) -> None:
    world.jump(ahead_s)
    time.sleep(seconds)
    world.jump(0)


def attacks(world: World) -> dict[str, Attack]:
    """All that can be done to this robot."""
    others = [name for name in world.rig.processes() if name != "serial_mcu_bridge"]
    short, owner = (0.5, 5.0), "serial_mcu_bridge"
    brokers = ["local broker"] if world.rig.local is not None else []
    found = {
        **{f"flood of {name}": Attack(partial(_flood, name), (3.0, 6.0)) for name in FLOODS},
        **{
            f"{name} stands still": Attack(partial(_freeze, name), short)
            for name in (*others, "launcher", "remote broker", *brokers)
        },
        f"{owner} stands still": Attack(partial(_freeze, owner), short, turns_s=_MCU_S),
        "the whole robot stands still": Attack(partial(_freeze, "robot"), (1.0, 10.0), turns_s=_MCU_S),
        **{f"{name} is killed": Attack(partial(_kill, name), (0.0, 0.0)) for name in (*others, *brokers)},
        f"{owner} is killed": Attack(partial(_kill, owner), (0.0, 0.0), turns_s=_MCU_S),
        "launcher is killed": Attack(partial(_kill, "launcher"), (0.0, 0.0), turns_s=_MCU_S),
        "the link is lost again and again": Attack(_reconnects, (1.0, 4.0)),
        "the link is silent": Attack(_blackhole, short),
        "remote broker is restored": Attack(_restore, (0.0, 0.0)),
        "clock is a day ahead": Attack(partial(_jump, 86_400.0), short),
        "clock is an hour behind": Attack(partial(_jump, -3_600.0), short),
    }
    if world.has_disks:
        found["full disks"] = Attack(_fill, short)
        found |= {
            f"full disks, and {name} is killed": Attack(partial(_fill, name=name), short, turns_s=_MCU_S)
            for name in ("mqtt_bridge", owner)
        }
    return found


def shuffled(world: World, chance: random.Random) -> list[str]:
    """Each of them once, in a random order."""
    names = sorted(attacks(world))
    chance.shuffle(names)
    return names
