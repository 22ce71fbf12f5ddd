"""When a script's drive commands are published, and when they have no effect."""

from __future__ import annotations

from typing import NamedTuple

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pebble.contract.payloads import Drive
from pebble.extensions.scripts.script.drive_sender import HOLD_S, MAX_PER_S, DriveSender
from tests.ext.operator.client.estop_robot import estop_state as state
from tests.support import cases

RUN = 17
AHEAD = Drive(z=0.5)
ZERO = Drive()


class Sent(NamedTuple):
    at: float
    z: float


class Sending:
    """A sender, what it has published, and a clock that is moved by hand; its timer is never late."""

    def __init__(self) -> None:
        self.now = 100.0
        self.published: list[Sent] = []
        self.accepts = True
        self.sender = DriveSender(RUN, self._publish)

    def _publish(self, drive: Drive) -> bool:
        assert (drive.source, drive.run) == ("autonomy", RUN)
        self.published.append(Sent(self.now, drive.z))
        return self.accepts

    def wait(self, seconds: float) -> None:
        end = self.now + seconds
        while (due := self.sender.due) is not None and due <= end:
            self.now = max(self.now, due)
            self.sender.tick(self.now)
            self.sender.ended(self.now)
        self.now = end

    def drive(self, drive: Drive) -> bool:
        return self.sender.drive(drive, self.now)

    def owner(self, name: str = "serial", **changes: object) -> None:
        self.sender.owners({name: state(**changes)}, self.now)

    @property
    def values(self) -> list[float]:
        return [sent.z for sent in self.published]


steps = st.lists(
    st.tuples(st.sampled_from([0.0, 1.0]), st.sampled_from([0.0, 0.0, 0.001, 0.004, 0.019, 0.05, 0.4])),
    max_size=300,
)


@settings(max_examples=cases(40, 100))
@given(steps)
def test_at_most_50_a_second_and_every_stop_at_once(wanted: list[tuple[float, float]]) -> None:
    sending = Sending()
    commands = [(z and (number + 1) / 1000, pause) for number, (z, pause) in enumerate(wanted)]
    for z, pause in commands:
        sending.drive(Drive(z=z))
        if z == 0.0:
            assert sending.values[-1] == 0.0, "the newest command on its way is the stop"
        sending.wait(pause)
    sending.wait(1.0)
    assert sending.values[-1:] == [z for z, _ in commands][-1:], "the newest wins"
    moving = [z for z in sending.values if z]
    assert moving == sorted(set(moving)), "none twice nor out of order"
    sending.drive(AHEAD)
    sending.sender.end("", sending.now)
    assert sending.values[-1] == 0.0
    for number, first in enumerate(sending.published):
        in_a_second = [sent for sent in sending.published[number:] if sent.at <= first.at + 1.0]
        assert len(in_a_second) <= MAX_PER_S


def test_a_stop_replaces_what_waits_and_nothing_follows_the_final_one() -> None:
    sending, ended = Sending(), Sending()
    for one in (sending, ended):
        one.drive(AHEAD)
        one.drive(Drive(z=0.9))
    assert sending.drive(ZERO)
    ended.sender.end("over", ended.now)
    assert not ended.drive(AHEAD)
    ended.sender.end("again", ended.now)
    for one in (sending, ended):
        one.wait(1.0)
        assert one.values == [0.5, 0.0]
    assert ended.sender.refusal(ended.now) == "over"


def test_without_a_connection_nothing_has_an_effect_and_a_stop_is_published_again() -> None:
    sending = Sending()
    sending.accepts = False
    assert not sending.drive(AHEAD)
    assert not sending.drive(ZERO)
    assert not sending.drive(ZERO)
    assert sending.values == [0.5, 0.0, 0.0], "at once"


def test_a_script_waits_while_a_person_drives() -> None:
    sending = Sending()
    assert sending.drive(AHEAD)
    sending.wait(0.1)
    sending.sender.receive(Drive(x=0.1), sending.now)
    assert not sending.drive(AHEAD)
    assert sending.sender.overridden(sending.now)
    sending.wait(HOLD_S - 0.01)
    assert not sending.drive(AHEAD)
    assert sending.values == [0.5]
    sending.wait(0.02)
    assert sending.drive(AHEAD)


def test_a_command_that_waits_is_not_published_once_a_person_drives() -> None:
    sending = Sending()
    sending.drive(AHEAD)
    assert sending.drive(Drive(z=0.9))
    sending.sender.receive(Drive(x=0.1), sending.now)
    sending.wait(1.0)
    assert sending.values == [0.5]


def test_its_own_commands_and_older_runs_do_not_refuse_it() -> None:
    sending = Sending()
    for run in (RUN, RUN - 1):
        sending.sender.receive(Drive(z=0.1, source="autonomy", run=run), sending.now)
    assert sending.drive(AHEAD)
    assert not sending.sender.overridden(sending.now)


@pytest.mark.parametrize("barred_first", [False, True])
def test_a_newer_run_supersedes_it(barred_first: bool) -> None:
    sending = Sending()
    sending.drive(AHEAD)
    messages = [
        lambda: sending.sender.receive(Drive(z=0.1, source="autonomy", run=RUN + 1), sending.now),
        lambda: sending.owner(barred=RUN),
    ]
    for notice in sorted(messages, key=messages.index, reverse=barred_first):
        notice()
        sending.wait(0.01)
        assert not sending.drive(AHEAD)
    assert sending.sender.ended(sending.now).startswith("superseded")


def test_a_script_that_never_drives_is_not_ended_and_publishes_nothing() -> None:
    sending = Sending()
    sending.owner(barred=RUN + 5)
    sending.owner(latched=True, count=1)
    sending.wait(1.0)
    assert sending.sender.ended(sending.now) == ""
    sending.sender.end("", sending.now)
    assert sending.published == []


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"barred": RUN}, "stopped by an operator"),
        ({"latched": True, "count": 1, "by": "anna", "why": "fire"}, "emergency stop by anna (fire)"),
        ({"count": 1, "by": "anna"}, "emergency stop by anna"),  # stopped and reset between two states
        ({"boot": "b2"}, "serial, which moves the wheels, has restarted"),
    ],
)
def test_a_run_does_not_outlive(change: dict[str, object], why: str) -> None:
    sending, away = Sending(), Sending()
    for one in (sending, away):
        one.owner()
        one.drive(AHEAD)
    away.sender.owners({}, away.now)
    for one in (sending, away):
        one.owner(**change)
        assert not one.drive(AHEAD), "also if the owner was away meanwhile"
    sending.wait(0.2)
    assert sending.sender.ended(sending.now) == why


def test_a_stopped_robot_refuses_and_a_reset_does_not_start_it() -> None:
    sending = Sending()
    sending.owner(latched=True, by="anna")
    assert not sending.drive(AHEAD)
    assert sending.sender.refusal(sending.now) == "the robot is stopped by anna"
    assert sending.sender.ended(sending.now) == ""
    sending.owner()
    assert sending.sender.ended(sending.now).startswith("the emergency stop was reset")
    assert sending.published == []
