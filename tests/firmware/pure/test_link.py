"""Getting to the broker, noticing its loss, and waiting before the next attempt."""

from common.link import Link

MASK = (1 << 30) - 1


def online(now: int = 0) -> Link:
    link = Link()
    assert link.step(now, True) == "resolve"
    link.move("connecting", now)
    link.move("online", now)
    return link


def test_the_way_there() -> None:
    link = Link()
    assert link.step(0, False) == ""
    assert link.state == "offline"
    assert link.step(10, True) == "resolve"
    assert link.state == "resolving"
    assert link.step(20, True) == ""
    link.move("connecting", 30)
    assert link.step(40, True) == ""
    link.move("online", 50)
    assert link.state == "online"


def test_each_step_of_the_way_may_take_so_long_and_no_longer() -> None:
    link = Link()
    link.step(0, True)
    assert link.step(3499, True) == ""
    assert link.step(3500, True) == "drop"
    assert link.reason == "resolving took too long"
    link.move("connecting", 0)
    assert link.step(7999, True) == ""
    assert link.step(8000, True) == "drop"
    assert link.reason == "connecting took too long"
    link.move("subscribing", 0)
    assert link.step(1999, True) == ""
    assert link.step(2000, True) == "drop"  # the first command may be as old as this


def test_silence_ends_a_connection() -> None:
    link = online()
    assert link.step(1999, True) == ""
    assert link.step(2000, True) == "drop"
    assert link.reason == "silence"


def test_whoever_is_heard_is_there() -> None:
    link = online()
    link.heard(1100)
    assert link.step(3099, True) == ""
    assert link.step(3100, True) == "drop"


def test_the_loss_of_the_wifi_drops_at_once() -> None:
    link = online()
    assert link.step(10, False) == "drop"
    assert link.state == "offline"
    link.lost(10, 0)
    assert link.state == "offline"
    assert link.step(20, False) == ""
    assert link.step(30, True) == "resolve"


def waits(link: Link, now: int, noise: int) -> int:
    """How long until the next attempt, after one that failed at ``now``."""
    link.lost(now, noise)
    ms = 0
    while link.step(now + ms, True) != "resolve":
        ms += 1
    return ms


def test_waiting_doubles_up_to_eight_seconds() -> None:
    link = Link()
    link.step(0, True)
    now, seen = 0, []
    for _ in range(6):
        ms = waits(link, now, 128)
        seen.append(ms)
        now += ms
    assert seen == [500, 1000, 2000, 4000, 8000, 8000]
    assert link.losses == 6


def test_attempts_of_many_robots_are_spread() -> None:
    def first(noise: int) -> int:
        link = Link()
        link.step(0, True)
        return waits(link, 0, noise)

    assert (first(0), first(128), first(255)) == (375, 500, 624)


def test_a_connection_that_held_makes_the_next_wait_short() -> None:
    link = Link()
    link.step(0, True)
    assert waits(link, 0, 128) == 500
    link.move("online", 0)
    link.step(4999, True)
    assert waits(link, 4999, 128) == 1000  # it did not hold
    link.move("online", 0)
    link.heard(5000)
    link.step(5000, True)
    assert waits(link, 5000, 128) == 500


def test_that_it_held_is_known_however_long_it_did() -> None:
    """Ticks a week apart look as if the later ones were the earlier."""
    link = online()
    link.lost(0, 128)
    link.move("online", 0)
    now = 0
    while now < 7 * 86_400_000:
        now += 1_000_000
        link.heard(now & MASK)
        assert link.step(now & MASK, True) == ""
    assert waits(link, now, 128) == 500
