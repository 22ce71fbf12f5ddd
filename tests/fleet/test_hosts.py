"""Robots with a list of brokers: killed, hung and cut off ones, while they are driven and stopped."""

from __future__ import annotations

import sys
from collections.abc import Iterator

import pytest

from tests.fleet.hosts_rig import FAULTS, Counts, Hosts, fail_while_driving, hosts
from tests.support import cases, further

pytestmark = pytest.mark.alone
NEVER = ("twice", "out of order", "older than 1 s", "false wills after the robot was heard elsewhere",
         "values older than the newest")  # fmt: skip
#: Seconds until the first heartbeat at another host.
ELSEWHERE_S = {"kill": 1.0, "freeze": 6.0, "part": 6.0, "cut": 1.0}


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Hosts]:
    with hosts(tmp_path_factory.mktemp("hosts")) as made:
        yield made


@pytest.mark.parametrize("fault", ["kill", *map(further, sorted(FAULTS.keys() - {"kill"}))])
def test_a_driven_robot_goes_to_another_host(world: Hosts, fault: str) -> None:
    counts = Counts()
    for _ in range(cases(1, 10)):
        fail_while_driving(world, fault, counts)
    sys.stdout.write(f"\n{fault}: {counts}\n")
    assert {what: counts.wrong[what] for what in NEVER} == dict.fromkeys(NEVER, 0)
    assert max(counts.took[f"{fault}: heartbeat elsewhere after"]) <= ELSEWHERE_S[fault]
    assert max(counts.took["wheels left turning"]) <= 1.0


@pytest.mark.thorough
@pytest.mark.parametrize("fault", FAULTS)
def test_a_stop_while_the_host_changes_takes_effect_once_one_is_heard(world: Hosts, fault: str) -> None:
    counts = Counts()
    for _ in range(cases(1, 5)):
        fail_while_driving(world, fault, counts, stops=True)
        world.reset()
    sys.stdout.write(f"\n{fault}, stops: {counts}\n")
    assert {what: counts.wrong[what] for what in NEVER} == dict.fromkeys(NEVER, 0)
    assert max(counts.took["stop confirmed after a host is heard"]) <= 1.0
    assert max(counts.took["wheels left turning"]) <= 1.0
