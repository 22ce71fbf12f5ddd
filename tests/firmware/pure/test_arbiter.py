"""Who moves the motors: people before scripts, and neither while latched."""

from common.arbiter import PERSON, REFUSED, Arbiter
from common.latch import Latch
from common.lease import Lease
from common.ticks import diff

READY = 2000  # scripts are refused until then
NAME = "00000000000000aa"


def arbiter(now: int = 0) -> Arbiter:
    return Arbiter(Latch("0badcafe", 4, diff), Lease(now, diff, str, 0), now, diff, 900)


def test_scripts_wait_for_a_person_who_releases() -> None:
    own = arbiter()
    assert own.judge(True, PERSON, -1, 3000) == 900
    assert own.judge(True, 17, -1, 3100) == REFUSED
    assert own.judge(False, PERSON, -1, 3200) == 0
    assert own.judge(True, 17, -1, 5199) == REFUSED
    assert own.judge(True, 17, -1, 5200) == 900
    assert own.barred == 16


def test_a_person_who_was_lost_ends_the_script() -> None:
    own = arbiter()
    own.judge(True, 17, -1, 3000)
    own.judge(True, PERSON, -1, 3100)
    assert own.judge(True, 17, -1, 5100) == REFUSED
    assert own.barred == 17
    assert own.judge(True, 18, -1, 5100) == 900


def test_a_persons_zero_ends_the_script_that_moves() -> None:
    own = arbiter()
    own.judge(True, 17, 400, 3000)
    assert own.judge(False, PERSON, -1, 3399) == 0
    assert own.barred == 17
    late = arbiter()
    late.judge(True, 17, 400, 3000)
    late.judge(False, PERSON, -1, 3400)
    assert late.barred == 16
    assert late.judge(True, 17, -1, 5400) == 900


def test_a_zero_that_is_no_release_always_ends_the_script() -> None:
    own = arbiter()
    own.judge(True, 17, 400, 3000)
    own.judge(False, PERSON, 0, 9000)
    assert own.barred == 17


def test_a_stop_ends_all_runs_so_far_and_those_received_while_it_lasts() -> None:
    own = arbiter()
    own.judge(True, 17, -1, 3000)
    assert own.stop(NAME, "ann", "", 0)
    assert not own.stop(NAME, "ann", "", 0)
    assert own.judge(True, PERSON, -1, 3100) == REFUSED
    assert own.judge(True, 18, -1, 3200) == REFUSED
    assert own.judge(False, PERSON, -1, 3300) == 0
    assert own.barred == 18
    assert own.latch.reset("0badcafe", 1, 0, 3400)
    assert own.judge(True, 18, -1, 6000) == REFUSED
    assert own.judge(True, 19, -1, 6000) == 900


def test_what_a_latched_owner_refuses_holds_nothing() -> None:
    own = arbiter()
    own.stop(NAME, "ann", "", 0)
    own.judge(True, PERSON, -1, 3000)
    own.latch.reset("0badcafe", 1, 0, 3000)
    assert own.judge(True, 17, -1, 3010) == 900


def test_ticks_may_wrap() -> None:
    start = (1 << 30) - 1000
    own = arbiter(start)
    own.tick(0)
    assert own.judge(True, 17, -1, 999) == REFUSED
    assert own.judge(True, 17, -1, 1000) == 900
    own.tick(1 << 28)  # once every few minutes is enough
    own.tick((1 << 28) + (1 << 29) - 1)
    assert own.judge(True, 17, -1, (1 << 29) + 1000) == 900
