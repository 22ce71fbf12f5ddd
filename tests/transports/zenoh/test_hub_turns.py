"""The hub's thread does its tasks in order, and what waits for it has room that is bounded."""

from __future__ import annotations

import threading
from functools import partial

import pytest

from pebble.transports.zenoh.hub import turns
from pebble.transports.zenoh.hub.turns import Places, Turns
from tests.support import until


def test_what_is_asked_for_comes_last_and_has_a_fifth_of_the_time(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = [0.0]
    monkeypatch.setattr(turns, "monotonic", lambda: clock[0])
    waiting, done = Turns(), list[str]()

    def work(name: str, seconds: float) -> None:
        done.append(name)
        clock[0] += seconds

    for number in range(64):
        if number < 4:
            waiting.ask("queries", "", partial(work, "asked", 1 / 8))
        waiting.put(partial(work, "other", 1 / 64))
    waiting.end()
    while (task := waiting.take(0)) is not None:
        task()
    others = ["other"] * 32  # four times as long as what was asked for
    assert done == ["asked", *others, "asked", *others, "asked", "asked"]


def test_kinds_of_what_is_asked_for_have_their_turns_and_names_of_each_kind() -> None:
    """So that who asks for one thing on and on holds up no one who greets, or asks for another."""
    waiting, done = Turns(), list[str]()
    for row in ("queries vera", "queries vera", "queries vera", "queries otto", "hellos otto", "hellos otto"):
        waiting.ask(*row.split(), partial(done.append, row))
    waiting.end()
    while (task := waiting.take(0)) is not None:
        task()
    assert done == [
        *("queries vera", "hellos otto", "queries otto", "hellos otto"),
        *("queries vera", "queries vera"),
    ]


def test_it_waits_for_a_task_and_for_no_longer_than_it_should() -> None:
    waiting, done = Turns(), list[int]()
    task = waiting.take(0.01)
    assert task is not None
    task()
    threading.Timer(0.05, partial(waiting.put, partial(done.append, 1))).start()
    task = waiting.take(20)
    assert task is not None
    task()
    assert done == [1]


def test_of_each_name_so_much_waits_and_a_number_of_senders() -> None:
    places = Places(10, senders=2)
    assert places.take("fred", 4)
    assert places.take("fred", 6)
    entered = list[bool]()
    senders = [threading.Thread(target=lambda: entered.append(places.take("fred", 5))) for _ in range(2)]
    for one in senders:
        one.start()
    assert until(lambda: places.outside.get("fred") == 2)
    assert not places.take("fred"), "a third sender"
    assert places.take("goob", 11), "another name, and what is larger than all the room"
    assert not entered
    places.leave("fred", 6)
    assert until(lambda: entered == [True])
    places.leave("fred", 4)
    assert until(lambda: entered == [True, True])
    for one in senders:
        one.join()
    places.leave("fred", 5)
    places.leave("fred", 5)
    places.leave("goob", 11)
    assert (places.taken, places.outside) == ({}, {})
