"""Getting to the broker, noticing its loss, and waiting before the next attempt."""

from wifi.connection import Connection


def online(now: int = 0) -> Connection:
    connection = Connection()
    assert connection.step(now, True) == "resolve"
    connection.move("connecting", now)
    connection.move("online", now)
    return connection


def test_each_step_of_the_way_may_take_so_long_and_no_longer() -> None:
    connection = Connection()
    connection.step(0, True)
    assert connection.step(3499, True) == ""
    assert connection.step(3500, True) == "drop"
    assert connection.reason == "resolving took too long"
    connection.move("connecting", 0)
    assert connection.step(7999, True) == ""
    assert connection.step(8000, True) == "drop"
    assert connection.reason == "connecting took too long"
    connection.move("subscribing", 0)
    assert connection.step(1999, True) == ""
    assert connection.step(2000, True) == "drop"  # the first command may be as old as this


def test_answers_hold_the_connection() -> None:
    connection = online()
    connection.received(1100)
    assert connection.step(3099, True) == ""
    assert connection.step(3100, True) == "drop"


def test_the_loss_of_the_wifi_drops_at_once() -> None:
    connection = online()
    assert connection.step(10, False) == "drop"
    assert connection.state == "offline"
    connection.lost(10, 0)
    assert connection.state == "offline"
    assert connection.step(20, False) == ""
    assert connection.step(30, True) == "resolve"


def test_only_what_fails_passes_the_turn_to_the_next_address() -> None:
    connection = online()
    connection.step(5000, True)
    connection.lost(5000, 0)  # it has worked
    assert connection.failures == 0
    connection.step(9000, True)
    connection.lost(9000, 0)
    assert connection.failures == 1
    connection.move("connecting", 20_000)
    connection.step(20_010, False)
    connection.lost(20_010, 0)  # without Wi-Fi
    assert connection.failures == 1
    connection.step(30_000, True)
    connection.move("online", 30_000)
    connection.lost(30_100, 0)  # accepted, and thrown out
    assert connection.failures == 2


def waits(connection: Connection, now: int, noise: int) -> int:
    """How long until the next attempt, after one that failed at ``now``."""
    connection.lost(now, noise)
    ms = 0
    while connection.step(now + ms, True) != "resolve":
        ms += 1
    return ms


def test_waiting_doubles_up_to_eight_seconds() -> None:
    connection = Connection()
    connection.step(0, True)
    now, seen = 0, []
    for _ in range(6):
        ms = waits(connection, now, 128)
        seen.append(ms)
        now += ms
    assert seen == [500, 1000, 2000, 4000, 8000, 8000]
    assert connection.losses == 6


def test_a_connection_that_held_makes_the_next_wait_short() -> None:
    connection = Connection()
    connection.step(0, True)
    assert waits(connection, 0, 128) == 500
    connection.move("online", 0)
    connection.step(4999, True)
    assert waits(connection, 4999, 128) == 1000  # it did not hold
    connection.move("online", 0)
    connection.received(5000)
    connection.step(5000, True)
    assert waits(connection, 5000, 128) == 500
