"""When a will is due, alone and among several hubs: in virtual time, without a hub."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import pytest

from pebble.transports.zenoh.hub.links import CUT_S, RENEWALS, Links
from pebble.transports.zenoh.hub.wills import (
    ALONE_S,
    HOME_S,
    LINK_S,
    MAX_LOST,
    MAX_RANK,
    PUT_OFF_S,
    RANK_S,
    RETURN_S,
    SUCCESSOR_S,
    WillTimes,
)

NEVER = float("inf")
LAST_S = SUCCESSOR_S + RANK_S * MAX_RANK

Event = Callable[[WillTimes], object]


def hub(name: str, present: bool = True) -> Event:
    return lambda wills: wills.on_hub(name, present=present)


def linked(at: float, present: bool = True, session: str = "z1") -> Event:
    return lambda wills: wills.on_link(session, at, present=present)


def hello(at: float, session: str = "z1", *, alive: bool = True, has_will: bool = True) -> Event:
    return lambda wills: wills.on_hello("c", session, at, alive=alive, has_will=has_will)


def gone(at: float) -> Event:
    return lambda wills: wills.on_gone("c", at)


def message(at: float) -> Event:
    return lambda wills: wills.on_message("c", at)


def back(wills: WillTimes) -> None:
    wills.on_alive("c")


def stood_still(at: float) -> Event:
    return lambda wills: wills.on_standstill(at)


HOME = (hub("n"), linked(0), hello(0))


@pytest.mark.parametrize(
    ("events", "due", "successor"),
    [
        pytest.param([linked(0), hello(0), gone(1)], 1 + ALONE_S, False, id="alone, as ever"),
        pytest.param([hello(0, ""), gone(1)], 1 + ALONE_S, False, id="alone, an old client"),
        pytest.param([hello(0, ""), gone(1), message(1.05)], 1 + ALONE_S, False, id="alone nothing puts it off"),
        pytest.param([*HOME, gone(1)], 1 + HOME_S, False, id="the home"),
        pytest.param([*HOME, linked(1, False), gone(1.1)], 1.1 + HOME_S, False, id="its link was lost just now"),
        pytest.param(
            [*HOME, linked(1, False), gone(2)], 2 + HOME_S + RANK_S, False, id="another is the home by now, perhaps"
        ),
        pytest.param(
            [*HOME, linked(1, False), gone(1 + LINK_S)], 1 + LINK_S + SUCCESSOR_S, True, id="its link was lost long ago"
        ),
        pytest.param([*HOME, linked(1, False), back, gone(2)], 2 + SUCCESSOR_S, True, id="it came back elsewhere"),
        pytest.param([hub("n"), hello(0), gone(1)], 1 + SUCCESSOR_S, True, id="the first successor"),
        pytest.param([hub("a"), hello(0), gone(1)], 1 + SUCCESSOR_S + RANK_S, True, id="the second successor"),
        pytest.param(
            [hub("a"), hello(0), gone(1), hub("a", False)], 1 + SUCCESSOR_S, True, id="its turn when it is due"
        ),
        pytest.param(
            [hub("a"), hub("a", False), hello(0), gone(1)], 1 + SUCCESSOR_S, True, id="the first is gone, too"
        ),
        pytest.param(
            [*(hub(f"a{number}") for number in range(20)), hello(0), gone(1)], 1 + LAST_S, True, id="one of many"
        ),
        pytest.param(
            [hub("n"), linked(0), hello(0, ""), gone(1)], 1 + SUCCESSOR_S, True, id="an old client has no home"
        ),
        pytest.param([*HOME, gone(1), back], NEVER, False, id="its token is back"),
        pytest.param([*HOME, gone(1), hello(1.1)], NEVER, False, id="it says hello again"),
        pytest.param([*HOME, gone(1), lambda wills: wills.forget("c")], NEVER, False, id="another hub published it"),
        pytest.param([*HOME, gone(1), message(1.2)], 1.2 + HOME_S, False, id="a message came later"),
        pytest.param([hub("n"), hello(0), gone(1), message(2)], 1 + SUCCESSOR_S, True, id="a message long before"),
        pytest.param(
            [*HOME, gone(0), *(message(number / 10) for number in range(300))],
            HOME_S + PUT_OFF_S,
            False,
            id="messages put it off for a while only",
        ),
        pytest.param([*HOME, stood_still(1), gone(1)], 1 + SUCCESSOR_S, True, id="the home stood still before"),
        pytest.param([*HOME, gone(1), stood_still(7)], 7 + LAST_S, True, id="the home stood still after"),
        pytest.param([hello(0), gone(1), stood_still(7)], 1 + ALONE_S, False, id="alone it may stand still"),
        pytest.param([hello(0, alive=False)], RETURN_S, False, id="a hello, and no token"),
        pytest.param(
            [hub("a"), hello(0, alive=False)],
            RETURN_S + SUCCESSOR_S + RANK_S,
            True,
            id="a hello, and no token, elsewhere",
        ),
        pytest.param([hello(0, alive=False, has_will=False)], NEVER, False, id="a hello without a will"),
        pytest.param([lambda wills: wills.on_restart(["c"], 0.0)], RETURN_S, True, id="a restart"),
        pytest.param([gone(0), lambda wills: wills.on_restart(["c"], 0.05)], ALONE_S, False, id="a restart while due"),
        pytest.param(
            [lambda wills: wills.on_restart(["c"], 0.0), lambda wills: wills.on_other_hub(["c"], 0.1)],
            0.1 + LAST_S,
            True,
            id="a restart, and another hub has it",
        ),
        pytest.param(
            [hub("a"), lambda wills: wills.on_restart(["c"], 0.0)], LAST_S + RANK_S, True, id="a journal that is late"
        ),
    ],
)
def test_due(events: list[Event], due: float, successor: bool) -> None:
    wills = WillTimes("m")
    for event in events:
        event(wills)
    assert wills.next_due == pytest.approx(due)
    assert wills.take_due(due - 1e-6) == []
    assert wills.take_due(due) == ([] if due == NEVER else [("c", successor)])
    assert wills.next_due == NEVER


def test_links_that_were_lost_are_bounded_and_those_that_stand_are_not_forgotten() -> None:
    wills = WillTimes("m")
    wills.on_hub("n", present=True)
    linked(0)(wills)
    hello(0)(wills)
    for number in range(2 * MAX_LOST):
        linked(number, True, f"s{number}")(wills)
        linked(number, False, f"s{number}")(wills)
    assert wills.is_home("c", 2.0 * MAX_LOST)


#: What the simulation below does to one client: (seconds, what).
_STORIES = {
    "the client dies": [(1.0, "die")],
    "its hub dies, and the client moves": [(1.0, "kill a"), (1.2, "move b")],
    "both die": [(1.0, "kill a"), (1.0, "die")],
    "its hub hangs, and the client moves late": [(1.0, "hang a"), (4.6, "move b"), (7.0, "resume a")],
    "both die, and a successor, too": [(1.0, "kill a"), (1.0, "die"), (2.0, "kill b")],
}


@pytest.mark.parametrize("story", _STORIES)
def test_one_of_three_hubs_publishes_a_will_and_only_if_the_client_is_gone(story: str) -> None:
    mesh = _Mesh("abc")
    mesh.play(_STORIES[story], until=15.0)
    assert mesh.published == (1 if "die" in dict(map(reversed, _STORIES[story])) else 0)  # type: ignore[arg-type]


class _Mesh:
    """Hubs that hear of each other at once; a client that is linked to the first of them."""

    def __init__(self, names: str) -> None:
        self.published = 0
        self._hubs = {name: WillTimes(name) for name in names}
        self._lease_s = 2.0
        self._late: dict[str, list[tuple[float, Event]]] = {}  # what a hub that hangs has not seen yet
        for name, wills in self._hubs.items():
            for other in names.replace(name, ""):
                wills.on_hub(other, present=True)
            hello(0)(wills)
        linked(0)(self._hubs["a"])

    def play(self, story: list[tuple[float, str]], until: float) -> None:
        events = [(at, partial(self._do, what)) for at, what in story]
        now = 0.0
        while now < until:
            now = round(now + 0.05, 2)
            for at, event in [one for one in events if one[0] <= now]:
                events.remove((at, event))
                event(now)
            for name, wills in list(self._hubs.items()):
                for _ in wills.take_due(now) if name not in self._late else ():
                    self.published += 1
                    for other in self._hubs.values():
                        other.forget("c")

    def _do(self, what: str, now: float) -> None:
        verb, _, name = what.partition(" ")
        getattr(self, f"_{verb}")(name, now)

    def _die(self, _: str, now: float) -> None:
        self._notify(linked(now, False), "a")
        self._notify(gone(now))

    def _kill(self, name: str, now: float) -> None:
        self._hubs.pop(name)
        self._notify(hub(name, False))
        self._notify(gone(now))

    def _hang(self, name: str, now: float) -> None:
        """The others notice after its lease; it notices when it runs again."""
        self._late[name] = [(now, linked(now + 6, False)), (now, gone(now + 6))]
        for other, wills in self._hubs.items():
            if other != name:
                wills.on_hub(name, present=False)
                wills.on_gone("c", now + self._lease_s)

    def _move(self, name: str, now: float) -> None:
        self._hubs[name].on_link("z1", now, present=True)
        self._notify(back)

    def _resume(self, name: str, now: float) -> None:
        wills = self._hubs[name]
        wills.on_standstill(now)
        for _, event in self._late.pop(name):
            event(wills)
        back(wills)  # the others tell it, once it is linked to them again

    def _notify(self, event: Event, *names: str) -> None:
        for name, wills in self._hubs.items():
            if name not in self._late and (not names or name in names):
                event(wills)


def test_a_hub_that_does_not_see_another_one_it_is_connected_to_begins_anew() -> None:
    made = Links(0.0)
    made.on_link("z1", 1.0, present=True)
    assert not made.is_cut(None, 50.0), "it is connected to what is no hub of ours"
    assert not made.is_cut(1, 100.0), "each is seen"
    made.on_link("z2", 100.0, present=True)
    renewed = [second - 100 for second in range(100, 100 + 2 * 3600) if made.is_cut(1, float(second))]
    assert CUT_S <= renewed[0] <= 2 * CUT_S + 1
    assert [len([at for at in renewed if at // 3600 == hour]) for hour in (0, 1)] == [RENEWALS, RENEWALS]
    assert not made.is_cut(1, 7300.0)
    assert not made.is_cut(2, 7300.0), "each is seen again"
    assert made.is_cut(1, 7300.0 + 2 * CUT_S + 1), "the last time may have helped"


def test_a_hub_that_hung_begins_anew_if_that_cost_it_a_connection() -> None:
    made = Links(0.0)
    made.on_link("z1", 1.0, present=True)
    made.on_standstill(10.0)
    assert not made.is_cut(1, 10.1), "it was short"
    made.on_link("z1", 10.2, present=False)
    made.on_link("z1", 10.3, present=True)
    assert made.is_cut(1, 10.4)
    made.on_new_session()
    made.on_link("z1", 11.0, present=True)
    assert not made.is_cut(1, 11.1)
    made.on_link("z1", 10.0 + LINK_S + 1, present=False)
    assert not made.is_cut(1, 10.0 + LINK_S + 2), "the other one was killed"
