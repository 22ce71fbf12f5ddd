"""A robot drives by itself in a simulated world: it follows a tag, obeys a person, and stops however a script ends.

``python -m tests.robot.closed_loop`` measures the same with many starts and rounds, and more.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import pytest

from tests.robot.closed_loop import perception
from tests.robot.closed_loop.aims import AIMS, Samples
from tests.robot.closed_loop.stops import ENDINGS, Ending, ended, overridden, overridden_on_the_robot, stopped_once
from tests.robot.world_rig import WorldRig

pytestmark = pytest.mark.alone  # deadlines are checked

ON_ONE = {"freeze": "zenoh", "manager": "zenoh", "launcher": "mqtt"}  # these take seconds


@pytest.fixture(scope="module", params=["zenoh", "mqtt"])
def rig(request: pytest.FixtureRequest) -> Iterator[WorldRig]:
    with WorldRig(request.param) as rig:
        yield rig


on_zenoh, on_mqtt = (pytest.mark.parametrize("rig", [kind], indirect=True) for kind in ("zenoh", "mqtt"))


def check(found: Samples) -> None:
    missed = {AIMS[key].name: samples for key, samples in found.items() if not AIMS[key].holds(samples)}
    assert missed == {}


@pytest.mark.parametrize("ending", [one for one in ENDINGS if one.key not in ON_ONE], ids=lambda one: one.key)
def test_the_wheels_rest_however_a_script_ends(rig: WorldRig, ending: Ending) -> None:
    check(ended(rig, ending))


@on_zenoh
@pytest.mark.parametrize("ending", [one for one in ENDINGS if ON_ONE.get(one.key) == "zenoh"], ids=lambda one: one.key)
def test_the_wheels_rest_however_a_script_ends_on_zenoh(rig: WorldRig, ending: Ending) -> None:
    check(ended(rig, ending))


@on_mqtt
@pytest.mark.parametrize("ending", [one for one in ENDINGS if ON_ONE.get(one.key) == "mqtt"], ids=lambda one: one.key)
def test_the_wheels_rest_however_a_script_ends_on_mqtt(rig: WorldRig, ending: Ending) -> None:
    check(ended(rig, ending))


@pytest.mark.parametrize(
    ("rig", "person"), [("zenoh", overridden), ("mqtt", overridden_on_the_robot)], indirect=["rig"]
)
def test_a_person_goes_first_and_the_script_resumes(rig: WorldRig, person: Callable[[WorldRig], Samples]) -> None:
    check(person(rig))


def test_one_stop_of_a_person_is_enough(rig: WorldRig) -> None:
    check(stopped_once(rig))


@on_mqtt
def test_a_script_stops_with_what_it_needs(rig: WorldRig) -> None:
    check(perception.crashed_dependency(rig))
