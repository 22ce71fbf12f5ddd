"""Several processes stand still at once, as on a machine that swaps, while the uplink fails and an operator drives."""

from __future__ import annotations

import os
import random
import signal
import threading
import time
from collections.abc import Callable
from contextlib import suppress

import pytest

from tests.robot.rig import STOP, Rig
from tests.robot.test_faults import Drive
from tests.support import cases, further, until

pytestmark = pytest.mark.alone  # deadlines are checked

SEED = 20
ROUNDS = cases(1, 2)
DEAD_MAN_S = 0.75  # after so long without a command the wheels stop, later than any pause between two of them


def stand_still(pid: int, seconds: float) -> None:
    with suppress(ProcessLookupError):
        os.kill(pid, signal.SIGSTOP)
        time.sleep(seconds)
        os.kill(pid, signal.SIGCONT)


def a_blackhole(rig: Rig, seconds: float) -> None:
    rig.uplink.blackhole()
    time.sleep(seconds)
    rig.uplink.resume()


def faults(rig: Rig) -> dict[str, Callable[[float], None]]:
    """What can happen for some seconds, except to the serial bridge: only it can stop the wheels."""

    def still(pid: int) -> Callable[[float], None]:
        return lambda seconds: stand_still(pid, seconds)

    pids = {name: pid for name, pid in rig.processes().items() if name != "serial_mcu_bridge"}
    brokers = {"remote broker": rig.remote.pid} | ({} if rig.local is None else {"local broker": rig.local.pid})
    return {
        "uplink": lambda seconds: a_blackhole(rig, seconds),
        **{name: still(pid) for name, pid in sorted((pids | brokers).items())},
    }


def test_two_things_at_once_stand_still(driven: Rig) -> None:
    chance = random.Random(SEED)
    for _ in range(ROUNDS):
        drive = Drive(driven)
        available = faults(driven)
        chosen = {name: chance.uniform(0.5, 3.0) for name in chance.sample(sorted(available), 2)}
        threads = [threading.Thread(target=available[name], args=(seconds,)) for name, seconds in chosen.items()]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        drive.end(time.monotonic())
        drive.check_stops()


@pytest.mark.parametrize("seconds", [further(1.2), 2.8])
def test_the_serial_bridge_stands_still(driven: Rig, seconds: float) -> None:
    """It cannot stop the wheels meanwhile (the MCU does), but it does so before anything else afterwards."""
    drive = Drive(driven)
    began = time.monotonic()
    stand_still(driven.processes()["serial_mcu_bridge"], seconds)
    over = time.monotonic()
    assert until(lambda: driven.mcu.drives(over), 5)
    drive.end(over)
    after = [wheels for at, wheels in driven.mcu.drives(began) if at >= began + DEAD_MAN_S]
    assert after[0] == STOP
    drive.check_stops(excused=(began, over + 0.1))
