"""Since when received bytes may have waited in the kernel."""

from __future__ import annotations

import socket

from pebble.transports.mqtt.incoming import WaitingTime, readable_bytes


def test_bytes_that_come_into_an_empty_socket_have_not_waited() -> None:
    waiting = WaitingTime(1.0)
    waiting.empty(5.0)
    waiting.found(100, 5.0)
    assert waiting.since == 5.0


def test_bytes_found_after_a_stop_may_have_waited_since_the_socket_was_last_empty() -> None:
    waiting = WaitingTime(1.0)
    waiting.empty(5.0)
    waiting.found(1000, 9.0)
    assert waiting.since == 5.0


def test_all_that_piled_up_is_as_old_and_what_came_later_is_not() -> None:
    waiting = WaitingTime(1.0)
    waiting.found(1000, 9.0)
    for now in (9.1, 9.2, 9.3):  # batches; more comes meanwhile
        waiting.read(400)
        assert waiting.since == 1.0
        waiting.found(2000, now)
    assert waiting.since == 9.0


def test_an_emptied_socket_ends_it() -> None:
    waiting = WaitingTime(1.0)
    waiting.found(1000, 9.0)
    waiting.read(900)
    waiting.empty(9.1)
    waiting.found(10, 9.2)
    assert waiting.since == 9.1


def test_the_kernel_knows_how_much_is_there() -> None:
    ours, theirs = socket.socketpair()
    with ours, theirs:
        assert readable_bytes(ours) == 0
        theirs.send(b"123")
        assert readable_bytes(ours) == 3
    assert readable_bytes(ours) == 0
