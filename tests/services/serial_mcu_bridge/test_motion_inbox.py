"""The inbox before the motors: the newest command and request of each sender, and every zero."""

import random

import pytest

from pebble.config import Security
from pebble.contract.payloads import ControlRequest, ControlTurn, ControlVouched, Drive, EstopCommand, EstopReset
from pebble.motors.control import Control
from pebble.motors.motion_inbox import MotionInbox
from pebble.transports import State

ANN, OTTO = ControlRequest(id="aaaaaaaa", by="ann", for_ms=10_000), ControlRequest(id="00000001", by="otto")
RELEASE = ControlRequest(id="aaaaaaaa", by="ann", want="release")


def control() -> Control:
    """Return that of an owner: ann has control, and otto asks for it."""
    made = Control(Security(), lambda _state: None, 0.0)
    for request in (ANN, OTTO):
        made.request(request, over=False, now=0.0)
    return made


def empty() -> MotionInbox:
    return MotionInbox(control())


def script(run: int, z: float = 0.5) -> Drive:
    return Drive(z=z, source="autonomy", run=run)


def drives(inbox: MotionInbox) -> list[Drive]:
    return [received.drive for received in inbox.take().drives]


ZERO, FINAL, JOY = Drive(), Drive(valid_ms=0), Drive(x=1, source="joystick")
#: Drive commands in the order of their arrival, and what waits then.
WAITING = {
    "only the newest of a person": ([Drive(z=number / 10) for number in range(1, 11)], [Drive(z=1.0)]),
    "a zero before what replaces it": ([Drive(z=1), ZERO, Drive(z=0.5), Drive(z=0.25)], [ZERO, Drive(z=0.25)]),
    "several zeros as one that still bars": ([FINAL, Drive(z=1), ZERO, Drive(z=0.5)], [FINAL, Drive(z=0.5)]),
    "the same in the other order": ([ZERO, Drive(z=1), FINAL, Drive(z=0.5)], [FINAL, Drive(z=0.5)]),
    "a person and each run have their place": (
        [script(1), Drive(z=1), script(2), script(1, 0.0), JOY], [script(2), script(1, 0.0), JOY],
    ),
}  # fmt: skip


@pytest.mark.parametrize(("arrived", "waiting"), WAITING.values(), ids=WAITING)
def test_what_waits(arrived: list[Drive], waiting: list[Drive]) -> None:
    inbox = empty()
    for drive in arrived:
        inbox.put_drive(drive, 0.0)
    assert drives(inbox) == waiting
    assert drives(inbox) == []


def test_any_number_of_runs_never_displaces_the_person() -> None:
    inbox = empty()
    inbox.put_drive(Drive(), 0.0)
    for run in range(1, 1000):
        inbox.put_drive(script(run), 0.0)
    waiting = drives(inbox)
    assert waiting[0] == Drive()
    assert waiting[1:] == [script(run) for run in range(993, 1000)]
    assert inbox.dropped == 999 - 7


def test_a_zero_of_every_sender_is_always_there_whatever_follows() -> None:
    for seed in range(100):
        chance = random.Random(seed)
        inbox, zeros = empty(), set()
        for _ in range(chance.randrange(1, 30)):
            run, z = chance.randrange(4), chance.choice((0.0, 0.0, 1.0))
            inbox.put_drive(script(run, z) if run else Drive(z=z), 0.0)
            zeros |= {run} if not z else set()
        waiting = drives(inbox)
        assert {drive.run if drive.signed else 0 for drive in waiting if not drive.moves} == zeros
        assert len(waiting) <= 8


def test_stops_have_one_place_per_name_and_are_bounded_and_so_are_resets() -> None:
    inbox, names = empty(), [f"{number:016x}" for number in range(20)]
    assert inbox.put_drive(Drive(), 0.0)
    for name in names:
        assert not inbox.put_stop(EstopCommand(stop=name))
        assert not inbox.put_stop(EstopCommand(stop=name))
        assert not inbox.put_reset(EstopReset(boot="a", count=1), 0.0)
    batch = inbox.take()
    assert [stop.stop for stop in batch.stops] == names[-8:]
    assert (len(batch.resets), len(batch.drives)) == (8, 1)
    assert inbox.put_stop(EstopCommand()), "the first after a take is marked"


def test_strangers_displace_nothing_of_who_has_control_or_asks_for_it() -> None:
    owner = control()
    inbox, held = MotionInbox(owner), Drive(z=1, key=owner.lease.key)
    inbox.put_drive(Drive(key=owner.lease.key), 0.0)
    for request in (ANN, OTTO):
        inbox.put_request(request, False, 0.0)
    inbox.put_drive(held, 0.0)
    for number in range(1000):
        inbox.put_drive(Drive(z=-1), 0.0)
        inbox.put_drive(Drive(z=-1, key=f"{number:08x}"), 0.0)
        inbox.put_drive(script(number + 1), 0.0)
        inbox.put_request(ControlRequest(id=f"f{number:07x}"), number % 2 == 0, 0.0)
    batch = inbox.take()
    assert [received.drive for received in batch.drives][:2] == [Drive(key=owner.lease.key), held]
    assert [received.drive for received in batch.drives if not received.drive.signed][2:] == [
        Drive(z=-1, key="000003e7")
    ]
    assert [received.request for received in batch.requests][:2] == [ANN, OTTO]
    assert len(batch.requests) == 8


def test_an_account_with_many_persons_has_one_place_for_each_id() -> None:
    owner = Control(Security(level="named"), lambda _state: None, 0.0)
    inbox = MotionInbox(owner)
    owner.request(ANN, over=False, now=0.0)
    owner.request(ControlRequest(id="00000001", by="otto/0"), over=False, now=0.0)
    inbox.put_request(ANN, False, 0.0)
    for person in range(20):
        inbox.put_request(ControlRequest(id="00000001", by=f"otto/{person}"), False, 0.0)
    assert [one.request.by for one in inbox.take().requests] == ["ann", "otto/19"]


#: What one client sends, and what waits then: whether it is a release, and whether it takes control over.
REQUESTS = {
    "the newest": ([(ANN, False), (ANN, False)], [(False, False)]),
    "a take that is repeated as a request": ([(ANN, True), (ANN, False)], [(False, True)]),
    "a release after it": ([(ANN, True), (RELEASE, False)], [(True, False)]),
    "a request after a release": ([(RELEASE, False), (ANN, False)], [(False, False)]),
    "no release takes over": ([(RELEASE, True)], [(True, False)]),
}


@pytest.mark.parametrize(("arrived", "waiting"), REQUESTS.values(), ids=REQUESTS)
def test_which_request_waits(arrived: list[tuple[ControlRequest, bool]], waiting: list[tuple[bool, bool]]) -> None:
    inbox = empty()
    for request, over in arrived:
        inbox.put_request(request, over, 0.0)
    assert [(one.request.ends(), one.over) for one in inbox.take().requests] == waiting


def test_the_newest_turn_of_each_owner_and_the_newest_vouched_time_wait_and_are_taken_once() -> None:
    inbox, vouched = empty(), ControlVouched(begin=1, end=3)
    arm, tail = ControlTurn(boot="b", turn=2), ControlTurn(boot="b", turn=1)
    assert inbox.put_turn("arm", ControlTurn(boot="b", turn=1))
    assert not inbox.put_turn("tail", tail)
    assert not inbox.put_turn("arm", arm)
    assert not inbox.put_vouched(ControlVouched(begin=1, end=2))
    assert not inbox.put_vouched(vouched)
    assert not inbox.put_drive(ZERO, 0.0)
    batch = inbox.take()
    assert (sorted(batch.turns, key=str), batch.vouched) == ([("arm", arm), ("tail", tail)], vouched)
    batch = inbox.take()
    assert (batch.turns, batch.vouched) == ([], None)
    assert inbox.put_vouched(vouched)
    assert not inbox.put_turn("arm", arm)


@pytest.mark.parametrize(("states", "lost"), [((State.CONNECTED,), False), ((State.CONNECTING, State.CONNECTED), True)])
def test_a_connection_that_was_lost_is_known_once(states: tuple[State, ...], lost: bool) -> None:
    inbox = empty()
    for state in states:
        inbox.note_state(state)
    assert inbox.put_drive(ZERO, 0.0)  # which itself is nothing to wake up for
    assert [inbox.take().lost for _ in range(2)] == [lost, False]
