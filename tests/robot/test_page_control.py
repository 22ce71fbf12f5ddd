"""Two servers of the page and a whole robot, which decides who drives it: on both transports, down to its motors."""

from __future__ import annotations

import time
from collections.abc import Callable

import pytest

from tests.ext.page.served import Page, Served
from tests.robot.rig import STOP, Rig
from tests.support import until

PERIOD_S = 0.05
HALF, FAST, OLD, SCRIPT = (0.5, 0.5), (0.7, 0.7), (0.9, 0.9), (-0.3, -0.3)


class Person:
    """A person at a page, who drives by gestures."""

    def __init__(self, page: Page, ref: str) -> None:
        self.page, self.ref, self.gesture = page, ref, 0
        assert page.knows(ref, 20)
        assert page.ready()

    @property
    def view(self) -> dict[str, object]:
        found: dict[str, object] = self.page.value(self.ref, "web/driver")
        return found

    def ask(self, *, over: bool = False) -> None:
        self.page.send("lease", ref=self.ref, take=True, over=over)

    def release(self) -> None:
        self.page.send("lease", ref=self.ref, take=False)

    def drive(self, z: float, until_: Callable[[], object], seconds: float = 5.0) -> bool:
        """A gesture until something is so; whether it is."""
        self.gesture += 1
        end = time.monotonic() + seconds
        while not (found := until_()) and time.monotonic() < end:
            self.page.drive(self.ref, self.gesture, z=z)
            time.sleep(PERIOD_S)
        return bool(found)


@pytest.mark.parametrize("kind", ["mqtt", "zenoh"])
def test_one_person_at_a_time_moves_the_motors(kind: str) -> None:
    with (
        Rig(kind) as rig,
        Served(rig.remote.port) as hall,
        Served(rig.remote.port, server="attic") as attic,
        hall.page(name="ann") as first,
        attic.page(name="otto") as second,
    ):
        ref = f"pebble/robots/{rig.name}"
        ann, otto = Person(first, ref), Person(second, ref)

        def driven(since: float) -> list[tuple[float, float]]:
            return [drive for _, drive in rig.mcu.drives(since)]

        assert until(lambda: ann.view["keeps"], 20)
        ann.ask()
        assert until(lambda: ann.view["you"])
        since = time.monotonic()
        assert ann.drive(0.5, lambda: HALF in driven(since))
        otto.ask()
        assert ann.drive(0.5, lambda: ann.view["asks"] == "otto")
        ann.release()
        assert until(lambda: otto.view["you"] and ann.view["by"] == "otto")
        since = time.monotonic()
        assert not ann.drive(0.9, lambda: OLD in driven(since), 0.5)
        assert otto.drive(0.7, lambda: FAST in driven(since))

        rig.operator.send("incoming/drive-values", {"x": 0, "z": 0.9, "key": "00000000"})  # a key of before
        rig.operator.send("incoming/drive-values", {"x": 0, "z": 0.9})  # none
        assert OLD not in driven(since)

        assert otto.drive(0.7, rig.mcu.turning)
        ann.ask(over=True)
        assert until(lambda: ann.view["you"] and rig.mcu.drives()[-1][1] == STOP)
        since = time.monotonic()
        assert not otto.drive(0.9, lambda: OLD in driven(since), 0.5)
        assert ann.drive(0.5, lambda: HALF in driven(since))
        first.close()
        assert until(lambda: otto.view["by"] == "")
