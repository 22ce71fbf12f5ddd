"""A stand-in of the original's boards, which never say what they can do: from no stick to driven, and back."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest

from pebble.extensions.page import silent_boards
from pebble.extensions.page.config import ListedRobot
from pebble.transports import MqttSettings, QoS, create
from tests.ext.page.attacker import Hall
from tests.ext.page.served import Page, Served
from tests.kit.played_robot import RecordingRobot
from tests.support import WAIT_S, Broker, until

_NAMES = itertools.count(1)


@pytest.fixture(autouse=True)
def _soon(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(silent_boards, "HEARD_S", 0.6)


@contextmanager
def silent(broker: Broker, name: str) -> Iterator[RecordingRobot]:
    """Yield a board that obeys drive commands, and takes no stop."""
    with RecordingRobot(broker.port, f"pebble/robots/{name}", capabilities={}) as board:
        board.deaf = True
        yield board


@pytest.fixture
def board(broker: Broker) -> Iterator[RecordingRobot]:
    with silent(broker, f"lamp{next(_NAMES)}") as board:
        yield board


def view(page: Page, ref: str) -> dict[str, Any]:
    return page.value(ref, "web/board") or {}


def drives(page: Page, ref: str) -> bool:
    return ((page.value(ref, "capabilities", "value") or {}).get("drive") or {}).get("available") is True


def refusals(page: Page) -> list[str]:
    return [one["why"] for one in page.refused]


def test_a_maintainer_lets_it_be_driven_over_a_restart_until_it_says_what_it_can_do(
    broker: Broker, board: RecordingRobot, tmp_path: Path
) -> None:
    ref = board.base
    with Hall(broker.port, tmp_path) as hall, hall.page("driver") as driver, hall.page("maintainer") as maintainer:
        assert until(lambda: view(driver, ref).get("silent") is True)
        assert (view(driver, ref)["by"], drives(driver, ref)) == ("", False)
        assert driver.ready()
        driver.drive(ref, 1, z=1.0)
        assert until(lambda: driver.refused)
        maintainer.send("board", ref=ref, do="allow", n=7)
        assert until(lambda: drives(driver, ref))
        assert (view(driver, ref)["by"], [one["n"] for one in maintainer.done]) == ("maintainer", [7])
        assert driver.take(ref)
        driver.drive(ref, 2, x=0.123456789, z=-1.0, y=0.5)
        driver.drive(ref, 2)
        assert until(lambda: len(board.drives()) == 4)
        moved, *zeros = board.drives()
        assert (moved, zeros) == ({"x": 0.123, "z": -1.0}, [{"x": 0.0, "z": 0.0}] * 3)
        driver.send("estop", ref=ref, stop="00000000000000ff")
        assert until(lambda: board.drives()[4:])
        driver.drive(ref, 3, z=1.0)
        assert until(lambda: refusals(driver)[1:] == ["Emergency stop"])
        noted = [(one.what, one.user) for one in hall.served.app.state.audit.read(100)]
        assert ("allow driving", "maintainer") in noted
    with Served(broker.port, people=tmp_path / "people.sqlite") as served, served.page() as page:
        assert until(lambda: drives(page, ref))
        page.send("board", ref=ref, do="withdraw")
        assert until(lambda: not drives(page, ref))
        page.send("board", ref=ref, do="allow")
        assert until(lambda: drives(page, ref))
        board.publish_capabilities({"drive": {"available": False}})
        assert until(lambda: view(page, ref)["silent"] is False and not drives(page, ref))


@pytest.mark.parametrize(
    ("level", "listed", "driven"),
    [
        (
            "open",
            {"allowed": {"drive": True}, "forbidden": {"drive": False}, "free": {"name": "A"}},
            ["allowed", "free"],
        ),
        ("named", {"bare": {"drive": True}, "plain": {"drive": True, "plain": True}}, ["plain"]),
    ],
)
def test_the_config_allows_forbids_or_leaves_it_to_people(
    broker: Broker, level: Any, listed: dict[str, Any], driven: list[str]
) -> None:
    with ExitStack() as stack:
        boards = {stack.enter_context(silent(broker, name)).base: ListedRobot(**listed[name]) for name in listed}
        page = stack.enter_context(stack.enter_context(Served(broker.port, level=level, listed=boards)).page())
        for ref in boards:
            assert until(lambda ref=ref: view(page, ref).get("silent") is True)
            page.send("board", ref=ref, do="allow")
        assert until(lambda: [ref.rpartition("/")[2] for ref in boards if drives(page, ref)] == driven)
        assert until(lambda: [one["ref"] for one in page.refused] == [ref for ref in boards if "free" not in ref])


def test_a_retained_command_blocks_until_it_is_cleared(broker: Broker, board: RecordingRobot, tmp_path: Path) -> None:
    ref = board.base
    parked = create("mqtt", "parker", MqttSettings(host="127.0.0.1", port=broker.port))
    parked.open(timeout=WAIT_S)
    assert parked.publish(f"{ref}/incoming/drive-values", b'{"z": 1.0}', qos=QoS.DELIVERED, retain=True)
    parked.close()
    with Hall(broker.port, tmp_path, listed={ref: ListedRobot(drive=True)}) as hall, hall.page("driver") as page:
        assert until(lambda: "retained on its topic" in view(page, ref).get("parked", ""))
        assert page.ready()
        assert page.take(ref)
        page.drive(ref, 1, z=0.5)
        assert until(lambda: refusals(page) == [view(page, ref)["parked"]])
        page.send("board", ref=ref, do="clear")
        assert until(lambda: view(page, ref)["parked"] == "")
        page.drive(ref, 2, z=0.5)
        assert until(lambda: {"x": 0.0, "z": 0.5} in board.drives())
