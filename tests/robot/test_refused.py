"""A whole robot whose local broker refuses subscriptions of the motor owner."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, cast

import pytest

from tests.robot.operator import retained_messages
from tests.robot.rig import BASE, Rig
from tests.support import RefusingBroker, until


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    with Rig("mqtt", local=RefusingBroker(tmp_path_factory.mktemp("local"))) as rig:
        yield rig


def refuse(rig: Rig, *metrics: str) -> None:
    cast(RefusingBroker, rig.local).refuse(*(f"{BASE}/incoming/{metric}" for metric in metrics))


def estop(rig: Rig) -> dict[str, Any]:
    newest = rig.operator.last("outgoing/capabilities")
    value: dict[str, Any] = newest.json["value"]["estop"] if newest is not None else {}
    return value


def state(rig: Rig) -> str:
    newest = rig.operator.last("outgoing/status")
    return str(newest.json["value"]["services"]["serial_mcu_bridge"]["state"]) if newest is not None else ""


@pytest.mark.parametrize("metric", ["estop", "estop-reset"])
def test_capabilities_follow_what_is_granted(rig: Rig, metric: str) -> None:
    own = {"owners": ["serial"], "status_topics": [f"{BASE}/outgoing/estop/serial"]}
    assert until(lambda: estop(rig).items() >= {"available": True, **own}.items())
    refuse(rig, metric)
    assert until(lambda: estop(rig).items() >= {"available": False, "owners": [], "status_topics": []}.items())
    assert until(lambda: "outgoing/estop/serial" not in retained_messages(rig.remote.port, BASE))
    assert state(rig) == "ready"
    refuse(rig)
    assert until(lambda: estop(rig).items() >= {"available": True, **own}.items())
    assert until(lambda: "outgoing/estop/serial" in retained_messages(rig.remote.port, BASE))


def test_a_robot_whose_drive_topic_is_refused_shows_it_and_tries_again(rig: Rig) -> None:
    refuse(rig, "drive-values")
    assert until(lambda: state(rig) == "failed", 30)
    assert "refuses the subscription to pebble/robots/rover/incoming/drive-values" in rig.log.read_text()
    refuse(rig)
    assert until(lambda: state(rig) == "ready", 30)
