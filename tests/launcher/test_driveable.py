"""Whether a robot can be driven follows from what its processes report."""

from __future__ import annotations

import pytest

from pebble.launcher.driveable import Driveable
from pebble.runtime.notes import Local, Mcu, Note, Reach

OWNER, BRIDGE = "serial_mcu_bridge", "mqtt_bridge"
READY = {OWNER: "ready", BRIDGE: "ready"}
WELL = {
    "link of the owner": (OWNER, Local(True)),
    "link of the bridge": (BRIDGE, Local(True)),
    "reach": (BRIDGE, Reach("serial", True)),
    "board": (OWNER, Mcu("ready", 0)),
}
#: What is different, and what follows.
CASES = {
    "all is well": ({}, "yes"),
    "port": ({"board": (OWNER, Mcu("absent", None, "no /dev/ttyACM0"))}, "no serial: no /dev/ttyACM0"),
    "stopped sending": (
        {"board": (OWNER, Mcu("silent", 10000))},
        "no serial: its board has stopped sending: it hangs, or has lost its power",
    ),
    "starts again and again": (
        {"board": (OWNER, Mcu("ready", 0, "", 3))},
        "unknown serial: its board has started again 3 times within a minute",
    ),
    "started again twice": ({"board": (OWNER, Mcu("ready", 0, "", 2))}, "yes"),
    "booting": ({"board": (OWNER, Mcu("booting", None))}, "unknown serial: its board is starting"),
    "never heard": ({"board": (OWNER, Mcu("ready", None))}, "unknown serial: its board has sent nothing yet"),
    "silent by design": (
        {"board": (OWNER, Mcu("ready", 10000))},
        "unknown serial: its board has sent nothing for 10 s",
    ),
    "line not reported": ({"board": None}, "unknown serial: it has just started"),
    "owner cut off": ({"link of the owner": (OWNER, Local(False, "no hub"))}, "no serial_mcu_bridge: no hub"),
    "bridge cut off": (
        {"link of the bridge": (BRIDGE, Local(False))},
        "no mqtt_bridge: it does not reach the other programs",
    ),
    "link not reported": ({"link of the bridge": None}, "unknown mqtt_bridge has just started"),
    "siblings apart": ({"reach": (BRIDGE, Reach("serial", False))}, "no mqtt_bridge receives nothing from serial"),
    "reach not reported": ({"reach": None}, "unknown mqtt_bridge has received nothing from serial yet"),
    "the worst counts": (
        {"board": (OWNER, Mcu("booting", None)), "reach": (BRIDGE, Reach("serial", False))},
        "no mqtt_bridge receives nothing from serial",
    ),
}


class Assessed(Driveable):
    """A motor line behind the bridge, and an inertial sensor; counts how often the status had to follow."""

    def __init__(self) -> None:
        lines = {OWNER: "serial", f"{OWNER}:imu": "imu"}
        super().__init__(lines, [OWNER], [BRIDGE], self._count)
        self.changes = 0

    def _count(self) -> None:
        self.changes += 1

    def receive(self, program: str, note: Note) -> None:
        """Hand the note to its handler, as the launcher does."""
        getattr(self, type(note).__name__.lower())(program, note)

    def shows(self, states: dict[str, str] | None = None) -> str:
        return " ".join((self.assessment(READY if states is None else states) or {}).values())


@pytest.mark.parametrize(("different", "expected"), CASES.values(), ids=CASES)
def test_the_worst_that_is_known_decides(different: dict[str, tuple[str, Note] | None], expected: str) -> None:
    robot = Assessed()
    for note in {**WELL, **different}.values():
        if note is not None:
            robot.receive(*note)
    assert robot.shows() == expected


@pytest.mark.parametrize(("program", "state"), [(OWNER, "init"), (BRIDGE, "restarting"), (OWNER, "stopped")])
def test_a_process_that_is_not_ready_drives_nothing(program: str, state: str) -> None:
    robot = Assessed()
    for note in WELL.values():
        robot.receive(*note)
    assert robot.shows({**READY, program: state}).startswith(f"no {program} is ")


def test_reports_of_a_process_end_with_it() -> None:
    robot = Assessed()
    for note in WELL.values():
        robot.receive(*note)
    assert robot.mcus == {"serial": {"state": "ready", "heard_ms": 0}}
    robot.ended(OWNER)
    assert robot.mcus == {}
    assert robot.shows() == "unknown serial_mcu_bridge has just started"


def test_the_age_of_what_was_received_is_not_published_by_itself() -> None:
    robot, counts = Assessed(), []
    for age in (None, 0, 1000, 0, 1000, 10000, 0):
        robot.receive(OWNER, Mcu("ready", age))
        counts.append(robot.changes)
    assert counts == [1, 2, 2, 2, 2, 3, 4]


def test_unknown_names_are_ignored() -> None:
    robot = Assessed()
    robot.receive("other", Mcu("ready", 0))
    robot.receive(BRIDGE, Reach("other", True))
    assert (robot.mcus, robot.changes) == ({}, 0)
