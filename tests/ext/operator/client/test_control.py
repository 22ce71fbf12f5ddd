"""Who has control of a robot, and who has stopped it: clients, and motor owners that answer them."""

from __future__ import annotations

import json
import random
from collections.abc import Callable

import pytest
from msgspec import UNSET

from pebble.contract import CAPABILITIES, CONTROL, CONTROL_STATE, codec
from pebble.contract.payloads import ControlRequest, ControlState, LinkState
from pebble.extensions.operator.client.control import ASKS_S, ControlClient, RobotControl
from pebble.extensions.operator.client.driveable import doubt_of, driveable_of, is_cut_off
from pebble.extensions.operator.client.pace_of_link import WIDE, pace_of
from pebble.extensions.operator.client.robot_estop import MAX_OWNERS, Reset, RobotEstop
from pebble.extensions.operator.client.robot_view import RobotView
from pebble.transports import Message
from tests.ext.operator.client.estop_robot import KeepingRobot, Robot, capabilities, outgoing
from tests.support import ROOT, cases

GOOB = "pebble/robots/goob"
STEP_S = 0.05


class World:
    """One robot, and clients that hear it at once; each has a view of its own."""

    def __init__(self, *owners: str) -> None:
        self.robot = KeepingRobot(GOOB, *owners)
        self.now = 100.0
        self.sent: list[Message] = []
        self.clients: list[ControlClient] = []
        self.pace = WIDE
        self.lost: Callable[[ControlClient], bool] = lambda _client: False  # whether its messages get lost

    def client(self, by: str = "ann") -> ControlClient:
        view = RobotView(GOOB)
        owners = [one.name for one in self.robot.owners]
        listed = capabilities(GOOB, {"estop": {"available": True, "owners": owners}})
        view.receive(CAPABILITIES, listed, self.now, self.now)
        client = ControlClient(view.control, by=by, device="desk", pace_of=lambda: self.pace)
        self.clients.append(client)
        self.receive(self.robot.states())
        return client

    def holder(self, by: str = "ann") -> ControlClient:
        client = self.client(by)
        client.ask(self.now)
        self.wait(STEP_S)
        assert client.held
        return client

    def receive(self, states: list[Message]) -> None:
        for client in self.clients:
            for state in states:
                client.robot.receive(state)
                client.update(self.now)

    def wait(self, seconds: float) -> None:
        for _ in range(round(seconds / STEP_S)):
            self.step()
            self.now = round(self.now + STEP_S, 6)

    def step(self) -> None:
        for client in list(self.clients):
            out = client.tick(self.now)
            self.sent += out
            self.receive(self.robot.take([] if self.lost(client) else out, self.now))

    def drive(self, client: ControlClient) -> list[bool]:
        """Which motor owners move by a command of this client; without a key it sends none."""
        return [client.key != "" and owner.drive(client.key, self.now) for owner in self.robot.owners]

    @property
    def held(self) -> list[bool]:
        return [client.held for client in self.clients]


def requests(messages: list[Message]) -> list[tuple[str, str]]:
    """The metric and what is wanted."""
    return [(one.topic.rpartition("/incoming/")[2], codec.decode(CONTROL, one.payload).want) for one in messages]


def test_free_control_is_given_at_once_and_repeated_every_second() -> None:
    world = World()
    ann = world.holder()
    assert world.drive(ann) == [True]
    world.wait(3.0)
    assert requests(world.sent) == [("control", "hold")] * 4
    assert len({one.payload for one in world.sent}) == 1
    request: ControlRequest = codec.decode(CONTROL, world.sent[0].payload)
    assert (request.id, request.by, request.device, request.for_ms) == (ann.id, "ann", "desk", 3000)


def test_over_a_thin_link_it_is_asked_for_more_rarely_and_longer() -> None:
    world = World()
    world.pace = pace_of(LinkState(level="thin", drive_hz=4, rtt_ms=600, queue_ms=0, t=1))
    ann = world.holder()
    world.wait(9.5)
    ann.release()
    world.wait(STEP_S)
    asked: list[ControlRequest] = [codec.decode(CONTROL, one.payload) for one in world.sent]
    assert [(one.want, one.for_ms, one.t) for one in asked] == [
        *(("hold", 10_000, 1000 * seconds) for seconds in (100, 105)),
        ("release", 3000, UNSET),
    ]
    world.lost = lambda _client: True
    ann.ask(world.now)
    world.wait(9.9)
    assert ann.wanted
    world.wait(0.2)
    assert (ann.wanted, ann.failed) == (False, "goob does not answer")


def test_who_drives_is_asked_and_may_let_the_other_drive() -> None:
    world = World()
    ann, bob = world.holder(), world.client("bob")
    world.drive(ann)
    bob.ask(world.now)
    world.wait(STEP_S)
    assert (world.held, ann.asked_by, bob.robot.who) == ([True, False], "bob", "ann")
    before = ann.key
    ann.release()
    world.wait(STEP_S)
    assert world.held == [False, True]
    assert bob.key not in ("", before)
    assert world.drive(ann) == [False]


def test_who_is_not_let_drive_asks_no_more_after_a_while() -> None:
    world = World()
    ann, bob = world.holder(), world.client("bob")
    bob.ask(world.now)
    for _ in range(round((ASKS_S + 1) / STEP_S)):
        world.drive(ann)
        world.wait(STEP_S)
    assert (world.held, bob.wanted, bob.failed) == ([True, False], False, "ann drives on")
    world.wait(3.0)
    assert ann.robot.state is not None
    assert ann.robot.state.asks_id == ""


def test_control_can_be_taken_and_who_has_lost_it_does_not_take_it_back() -> None:
    world = World()
    ann, bob = world.holder(), world.client("bob")
    world.drive(ann)
    bob.ask(world.now, over=True)
    world.wait(STEP_S)
    assert world.held == [False, True]
    world.wait(20.0)
    assert world.held == [False, True]
    assert requests(world.sent).count(("control/take", "hold")) == 1


# -- several motor owners


def test_a_motor_owner_that_is_started_again_gives_control_anew() -> None:
    world = World()
    ann = world.holder()
    before = ann.decided
    world.robot.owners[0].start(world.now)
    world.receive(world.robot.states())
    assert (ann.held, ann.key) == (False, "")
    world.wait(STEP_S)
    assert ann.held
    assert ann.decided != before


def test_the_first_motor_owner_by_name_decides_and_who_has_only_another_gives_it_back() -> None:
    world = World("arm", "wheels")
    ann, bob = world.holder(), world.client("bob")
    world.drive(ann)
    world.robot.owners[1].start(world.now)
    bob.ask(world.now)
    out = bob.tick(world.now)  # it is heard before the holder is
    world.receive(world.robot.take(out, world.now))
    assert world.held == [True, False]
    assert world.drive(bob) == [False, False]
    for _ in range(round(2.5 / STEP_S)):
        world.drive(ann)
        world.wait(STEP_S)
    assert world.held == [True, False]
    assert world.drive(ann) == [True, True]


def test_random_schedules_never_have_two_holders_and_end_with_one() -> None:
    for seed in range(cases(20, 400)):
        chance = random.Random(seed)
        world = World(*("arm", "wheels")[: chance.randrange(1, 3)])
        clients = [world.client(name) for name in ("ann", "bob", "eve")]
        silent: set[ControlClient] = set()
        world.lost = silent.__contains__
        for _ in range(40):
            one = chance.choice(clients)
            match chance.randrange(7):
                case 0 | 1:
                    one.ask(world.now, over=chance.random() < 0.3)
                case 2:
                    one.release()
                case 3:
                    silent.symmetric_difference_update({one})
                case 4:
                    chance.choice(world.robot.owners).start(world.now)
                    world.receive(world.robot.states())
                case _:
                    world.drive(one)
            world.wait(chance.choice((0.05, 0.3, 1.0, 4.0)))
            assert sum(world.held) <= 1, seed
            assert {client.key == "" for client in clients if not client.held} <= {True}, seed
        silent.clear()
        for client in clients:
            client.release()
        world.wait(4.0)
        clients[0].ask(world.now)
        world.wait(2.0)
        assert (world.held, world.drive(clients[0])) == ([True, False, False], [True] * len(world.robot.owners)), seed


# -- what is received


def state(**fields: object) -> bytes:
    return codec.encode(CONTROL_STATE, {"by": "ann", "id": "3f2a91c0", "key": "0badf00d", **fields})


@pytest.mark.parametrize("payload", [b"{", state(id="3f2a91c0" * 2), b" " * 2000])
def test_what_is_no_state_changes_nothing(payload: bytes) -> None:
    control = RobotView(GOOB).control
    assert not control.receive(Message(f"{GOOB}/outgoing/control/serial", payload))
    assert control.state is None


def test_names_are_short_and_printable() -> None:
    control = RobotView(GOOB).control
    assert control.receive(Message(f"{GOOB}/outgoing/control/serial", state(by="Ann\x1b[2J" + 90 * "x")))
    assert control.who == "ann__2j" + 33 * "x"


def test_invented_owners_decide_nothing_and_are_bounded() -> None:
    world = World("wheels")
    ann = world.holder()
    for number in range(40):
        ann.robot.receive(Message(f"{GOOB}/outgoing/control/a{number}", state()))
    ann.update(world.now)
    assert ann.held
    assert len(ann.robot._states) <= 16
    view = RobotView(GOOB)
    assert isinstance(view.control, RobotControl)
    empty = ControlState(by="", id="", key="")
    view.control.receive(Message(f"{GOOB}/outgoing/control/serial", codec.encode(CONTROL_STATE, empty)))
    assert view.control.who == ""


# -- who is stopped by what a robot publishes, and what a reset may end


STOP = {"stop": "0123456789abcdef", "by": "ann@desk", "why": "dog"}
STATE = {"latched": True, "boot": "00c0ffee", "count": 1, "recent": [], "by": "ann", "why": "dog", "since": 5}


def stopped(*names: str) -> tuple[Robot, RobotEstop]:
    """A robot with these owners, all stopped, and what a client has received from it."""
    robot, estop = Robot(GOOB, *names), RobotEstop(GOOB)
    estop.receive(robot.capabilities())
    stop(robot, estop, STOP)
    return robot, estop


def stop(robot: Robot, estop: RobotEstop, body: dict[str, str]) -> None:
    publish(estop, robot.take([Message(f"{GOOB}/incoming/estop", json.dumps(body).encode())]))


def publish(estop: RobotEstop, messages: list[Message]) -> None:
    for message in messages:
        estop.receive(message)


def test_a_robot_is_stopped_if_any_owner_is() -> None:
    robot, estop = Robot(GOOB, "left", "right"), RobotEstop(GOOB)
    publish(estop, [robot.capabilities(), *(owner.state() for owner in robot.owners)])
    assert (estop.latched, estop.stopped_by, estop.old) == ({}, None, False)
    robot.owners[1].latch.stop(STOP["stop"], "ann@desk", "dog", 7)
    publish(estop, [robot.owners[1].state()])
    assert list(estop.latched) == ["right"]
    assert estop.stopped_by is not None
    assert (estop.stopped_by.by, estop.stopped_by.why, estop.stopped_by.since) == ("ann@desk", "dog", 7)


def test_a_state_that_was_removed_or_of_an_owner_that_was_does_not_count() -> None:
    estop = RobotEstop(GOOB)
    assert estop.receive(outgoing(GOOB, "estop/removed", STATE, retain=True))
    assert list(estop.latched) == ["removed"], "as long as the owners are not known"
    estop.receive(Robot(GOOB, "serial").capabilities())
    assert estop.latched == {}
    estop.receive(outgoing(GOOB, "estop/serial", STATE))
    assert list(estop.latched) == ["serial"]
    assert estop.receive(Message(f"{GOOB}/outgoing/estop/serial", b""))
    assert estop.states == {}
    estop.receive(capabilities(GOOB, {}))
    assert (estop.latched, estop.old) == ({}, True)


@pytest.mark.parametrize("body", [{}, "x", STATE | {"latched": 1}, STATE | {"why": "x" * 2000}])
def test_what_is_no_state_of_a_stop_changes_nothing(body: object) -> None:
    estop = RobotEstop(GOOB)
    assert not estop.receive(outgoing(GOOB, "estop/serial", body))
    assert not estop.receive(outgoing(GOOB, "capabilities", body))
    assert not estop.receive(outgoing(GOOB, "online", STATE))
    assert (estop.states, estop.has_capabilities) == ({}, False)


def test_texts_of_states_are_short_and_harmless() -> None:
    estop = RobotEstop(GOOB)
    state = STATE | {"by": "\x1b]0;evil\x07" + "x" * 99, "why": "\u202e" * 41, "since": 10**40, "recent": ["n"] * 20}
    assert estop.receive(outgoing(GOOB, "estop/serial", state))
    clean = estop.states["serial"]
    assert (clean.by[:9], len(clean.by), clean.why, clean.since) == ("?]0;evil?", 32, "?" * 40, 0)
    assert len(clean.recent) == 8


def test_the_number_of_owners_is_limited_and_listed_ones_are_preferred() -> None:
    estop = RobotEstop(GOOB)
    for number in range(3 * MAX_OWNERS):
        estop.receive(outgoing(GOOB, f"estop/o{number}", STATE))
    assert len(estop.states) == MAX_OWNERS
    estop.receive(Robot(GOOB, "serial").capabilities())
    assert estop.receive(outgoing(GOOB, "estop/serial", STATE))
    for number in range(3 * MAX_OWNERS):
        estop.receive(outgoing(GOOB, f"estop/p{number}", STATE))
    assert list(estop.latched) == ["serial"]


# -- resets


def test_a_reset_frees_each_stopped_owner_by_its_own_boot_and_count() -> None:
    robot, estop = stopped("left", "right", "spare")
    spare = robot.owners[2]
    assert spare.latch.reset(spare.latch.boot, spare.latch.count, age=0, now=0)
    publish(estop, [spare.state()])
    reset = Reset(estop, "ann@desk")
    assert [json.loads(message.payload) for message in reset.messages()] == [
        {"boot": "00000000", "count": 1, "by": "ann@desk"},
        {"boot": "00000001", "count": 1, "by": "ann@desk"},
    ]
    assert {message.topic for message in reset.messages()} == {f"{GOOB}/incoming/estop-reset"}
    assert reset.waiting == ["left", "right"]
    publish(estop, robot.take(reset.messages()))
    assert estop.states["left"].reset_refused == "boot", "by the other owner's reset, which does not matter"
    assert (reset.waiting, reset.refusals()) == ([], {})


def test_a_reset_ends_no_stop_that_was_not_shown() -> None:
    robot, estop = stopped("serial")
    reset = Reset(estop, "ann@desk")
    stop(robot, estop, {"stop": "fedcba9876543210", "by": "bob"})
    assert [json.loads(message.payload)["count"] for message in reset.messages()] == [1]
    publish(estop, robot.take(reset.messages()))
    assert robot.owners[0].latch.latched
    assert reset.waiting == []
    assert reset.refusals() == {"serial": "stopped again meanwhile by bob"}


def test_a_reset_reports_owners_that_have_restarted_or_are_silent() -> None:
    robot, estop = stopped("left", "right")
    reset = Reset(estop, "ann@desk")
    publish(estop, [outgoing(GOOB, "estop/left", STATE | {"boot": "12345678"})])
    assert reset.waiting == ["right"]
    assert reset.refusals() == {"left": "it has restarted since", "right": "no answer (may this account reset it?)"}
    robot.owners[1].latch.reset("00000001", 1, age=1000, now=0)
    publish(estop, [robot.owners[1].state()])
    assert reset.refusals()["right"] == "the reset reached it too late"


WHY = "serial: no /dev/ttyACM0"


@pytest.mark.parametrize(
    ("driveable", "driven", "stopped"),
    [
        ({"state": "no", "why": WHY}, f"Cannot be driven: {WHY}", f"nothing confirms that its motors stand: {WHY}"),
        ({"state": "unknown"}, "Not known whether it can be driven", "it is not known whether its motors stand"),
        ({"state": "no", "why": "x" * 9000}, f"Cannot be driven: {'x' * 300}", None),
        ({"state": "yes"}, "", ""),
        (None, "", ""),  # an older robot
        ({"state": ["no"]}, "", ""),
    ],
)
def test_a_status_tells_in_the_words_of_the_page_whether_a_robot_can_be_driven(
    driveable: object, driven: str, stopped: str | None
) -> None:
    found = driveable_of(json.dumps({"t": 1, "value": {"services": {}, "driveable": driveable}}).encode())
    assert doubt_of(found) == driven
    assert stopped is None or doubt_of(found, stopped=True) == stopped
    assert is_cut_off(found) is driven.startswith("Cannot")
    assert driven.partition(":")[0] in (ROOT / "pebble/extensions/page/static/ui/fleet/doubt.js").read_text()
