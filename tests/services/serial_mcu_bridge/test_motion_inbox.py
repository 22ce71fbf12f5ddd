"""The inbox before the motors: the newest command of each sender, and every zero."""

import random

from pebble.contract.payloads import Drive, EstopCommand, EstopReset
from pebble.services.serial_mcu_bridge.motion.motion_inbox import MotionInbox

NAMES = [f"{number:016x}" for number in range(20)]


def script(run: int, z: float = 0.5) -> Drive:
    return Drive(z=z, source="autonomy", run=run)


def drives(inbox: MotionInbox) -> list[Drive]:
    return [received.drive for received in inbox.take().drives]


def test_only_the_newest_command_of_a_person_waits() -> None:
    inbox = MotionInbox()
    for number in range(1, 11):
        inbox.put_drive(Drive(z=number / 10), 0.0)
    assert drives(inbox) == [Drive(z=1.0)]
    assert drives(inbox) == []


def test_a_zero_waits_before_the_command_that_replaces_it() -> None:
    inbox = MotionInbox()
    for drive in (Drive(z=1), Drive(), Drive(z=0.5), Drive(z=0.25)):
        inbox.put_drive(drive, 0.0)
    assert drives(inbox) == [Drive(), Drive(z=0.25)]


def test_several_zeros_become_one_that_still_bars_the_run() -> None:
    for order in ((Drive(valid_ms=0), Drive()), (Drive(), Drive(valid_ms=0))):
        inbox = MotionInbox()
        for drive in order:
            inbox.put_drive(drive, 0.0)
        assert drives(inbox) == [Drive(valid_ms=0)]
        for drive in (order[0], Drive(z=1), order[1], Drive(z=0.5)):
            inbox.put_drive(drive, 0.0)
        assert drives(inbox) == [Drive(valid_ms=0), Drive(z=0.5)]


def test_a_person_and_each_run_have_a_place_of_their_own() -> None:
    inbox = MotionInbox()
    for drive in (script(1), Drive(z=1), script(2), script(1, 0.0), Drive(x=1, source="joystick")):
        inbox.put_drive(drive, 0.0)
    assert drives(inbox) == [script(2), script(1, 0.0), Drive(x=1, source="joystick")]


def test_any_number_of_runs_never_displaces_the_person() -> None:
    inbox = MotionInbox()
    inbox.put_drive(Drive(), 0.0)
    for run in range(1, 1000):
        inbox.put_drive(script(run), 0.0)
    waiting = drives(inbox)
    assert waiting[0] == Drive()
    assert waiting[1:] == [script(run) for run in range(993, 1000)]
    assert inbox.dropped == 999 - 7


def test_a_zero_of_every_sender_is_always_there_whatever_follows() -> None:
    for seed in range(300):
        chance = random.Random(seed)
        inbox, zeros = MotionInbox(), set()
        for _ in range(chance.randrange(1, 30)):
            run, z = chance.randrange(4), chance.choice((0.0, 0.0, 1.0))
            inbox.put_drive(script(run, z) if run else Drive(z=z), 0.0)
            zeros |= {run} if not z else set()
        waiting = drives(inbox)
        assert {drive.run if drive.signed else 0 for drive in waiting if not drive.moves} == zeros
        assert len(waiting) <= 8


def test_stops_have_one_place_per_name_and_are_bounded() -> None:
    inbox = MotionInbox()
    assert inbox.put_stop(EstopCommand(stop=NAMES[0]))
    for name in NAMES:
        assert not inbox.put_stop(EstopCommand(stop=name))
        assert not inbox.put_stop(EstopCommand(stop=name))
    assert [stop.stop for stop in inbox.take().stops] == NAMES[-8:]


def test_the_first_put_after_a_take_is_marked() -> None:
    inbox = MotionInbox()
    assert inbox.put_drive(Drive(), 0.0)
    assert not inbox.put_reset(EstopReset(boot="a", count=1), 0.0)
    assert not inbox.put_stop(EstopCommand())
    batch = inbox.take()
    assert (len(batch.stops), len(batch.resets), len(batch.drives)) == (1, 1, 1)
    for _ in range(20):
        inbox.put_reset(EstopReset(boot="a", count=1), 0.0)
    assert len(inbox.take().resets) == 8
    assert inbox.put_stop(EstopCommand())
