"""What is asked of hubs, by real sessions."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import zenoh

from pebble.transports import ZenohSettings
from pebble.transports.zenoh import wire
from pebble.transports.zenoh.callbacks import direct
from pebble.transports.zenoh.session import close_session, open_session, session_config

KEY = "@hub/hello"


@pytest.fixture
def session(tmp_path: Path) -> Iterator[zenoh.Session]:
    opened = open_session(session_config(ZenohSettings(run_dir=tmp_path), "peer", listen=[], connect=[]))
    yield opened
    close_session(opened)


def test_a_hub_that_has_just_died_holds_up_no_answer_of_another(session: zenoh.Session) -> None:
    held: list[zenoh.Query] = []
    session.declare_queryable(KEY, direct(held.append))  # it has the question, and never answers
    session.declare_queryable(KEY, direct(lambda query: _answer(query, b"here")))
    began = time.monotonic()
    assert wire.ask(session, KEY, b"", 5.0) == b"here"
    assert time.monotonic() - began < 3.0
    assert len(held) == 1


def test_without_an_answer_it_waits_for_as_long_as_it_may(session: zenoh.Session) -> None:
    held: list[zenoh.Query] = []
    session.declare_queryable(KEY, direct(held.append))
    began = time.monotonic()
    assert wire.ask(session, KEY, b"", 0.5) is None
    assert 0.4 < time.monotonic() - began < 3.0


def _answer(query: zenoh.Query, payload: bytes) -> None:
    with query:
        query.reply(KEY, payload)
