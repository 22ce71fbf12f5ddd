"""Who drives a robot by way of one server: what moves, what stops, and what never moves again, as histories."""

from __future__ import annotations

import json
from itertools import count, groupby
from types import SimpleNamespace
from typing import Any

import pytest
from msgspec import UNSET

from pebble import contract as c
from pebble.contract import codec, groups
from pebble.contract.levels import LEVELS
from pebble.contract.payloads import LinkLevel, LinkState
from pebble.extensions.operator.client.pace_of_link import WIDE
from pebble.extensions.operator.client.robot_view import RobotView
from pebble.extensions.page.drive import drivers as module
from pebble.extensions.page.drive.driven_robot import TABLE, Event, State, Tab
from pebble.extensions.page.drive.drivers import MOST_WISHES, Drivers
from pebble.extensions.page.messages import DriveOp, DriverView
from pebble.transports import Message, QoS
from tests.ext.operator.client.estop_robot import KeepingRobot

GOOB, FRED = "pebble/robots/goob", "pebble/robots/fred"
STEP_S = 0.05
STRANGER = "0e0e0e0e"  # a client of another server


class World:
    """One server, two robots that keep control or do not, and pages; what happens is said in lines of words.

    A line is ``who verb what: what is published meanwhile, and what is refused``. A command that moves is ``go``;
    one of zero speed ``zero``, or ``final`` if it is nobody's letting go. Those to the other robot begin with its name.
    """

    def __init__(self, *, keeps: bool) -> None:
        self.now = 100.0
        self.happened: list[str] = []
        self.sent: list[tuple[str, Any, QoS]] = []
        self.tabs: dict[str, Tab] = {}
        self.tokens: dict[str, str] = {}
        self.marked: set[str] = set()
        self.accepts = True
        self.blocked = self.nameless = ""
        self.granted = 0
        self._numbers = count(1)
        self._arriving: list[Message] = []
        self.owners = {base: KeepingRobot(base) for base in (GOOB, FRED)}
        self.views = {base: RobotView(base) for base in (GOOB, FRED)}
        broker = SimpleNamespace(publish=self._publish)
        robots = SimpleNamespace(
            view=self.views.get,
            topic=lambda ref, *_: c.DRIVE.topic(ref),
            mark_drivers=self.marked.update,
            capabilities=lambda ref: self.views[ref].capabilities,
        )
        self.drivers = Drivers(broker, robots)  # type: ignore[arg-type]
        self.drivers.refusals = SimpleNamespace(
            of_driving=lambda _ref: self.blocked, nameless=lambda _view: self.nameless
        )  # type: ignore[assignment]
        for owner in self.owners.values():
            owner.owners[0].start(self.now)
        for base in self.views:
            self.publish_capabilities(base, keeps=keeps)

    # -- what is said

    def tell(self, history: str) -> None:
        """Perform a history, and compare what follows from each line."""
        for line in filter(None, map(str.strip, history.splitlines())):
            said, _, expected = line.partition(": ")
            self.happened = []
            self.perform(said.rstrip(":").split())
            assert self.happened == [part for part in expected.split(", ") if part], line

    def perform(self, words: list[str]) -> None:
        ref = FRED if words[-1] == "fred" else GOOB
        words = [word for word in words if word != "fred"]
        match words:
            case ["stop"]:
                self.drivers.stop(ref, "eve")
            case ["wait", seconds]:
                self.wait(float(seconds))
            case ["freeze", seconds]:  # of this process
                self.now += float(seconds)
            case ["blocked", *why]:
                self.blocked = " ".join(why)
            case ["deaf"] | ["hears"]:  # the broker
                self.accepts = words == ["hears"]
            case ["moved"]:
                self.note(self.drivers.robot(ref).moved_by or "nobody")
            case ["robot", *what]:
                self.perform_robot(ref, what)
            case ["stranger", want]:
                self.ask_as_stranger(ref, want)
            case [who, *what]:
                self.perform_page(who, ref, what)
        self.settle()

    def perform_robot(self, ref: str, what: list[str]) -> None:
        match what:
            case ["restarts"]:
                self.owners[ref].owners[0].start(self.now)
                self.receive(self.owners[ref].states())
            case ["keeps", how]:
                self.publish_capabilities(ref, keeps=how == "control")
            case ["forgotten"]:
                self.views[ref] = RobotView(ref)
                self.drivers.updated(ref)
            case ["silent"]:
                self.owners[ref].owners[0].receives = False
            case ["drives", "not"]:
                self.views[ref].capabilities = {"outlets": {}}
            case ["tells", "nothing"]:
                self.views[ref].capabilities = {}
            case ["takes", "groups"]:
                self.views[ref].capabilities["groups"] = ["drive-values", "lights-solid"]
            case ["takes", "names"]:
                self.nameless = "goob takes commands with names only"

    def perform_page(self, who: str, ref: str, what: list[str]) -> None:
        if what == ["returns"]:
            self.connect(who, token=self.tokens[who])
            return
        tab = self.tabs.get(who) or self.connect(who)
        match what:
            case ["takes"] | ["takes", "over"]:
                view = self.views[ref]
                self.drivers.take(tab, view, self.grant, self.note, over=len(what) == 2)
            case ["drives", g, *late]:
                self.drive(tab, ref, int(g), late, z=0.5)
            case ["goes", "on", g, "for", seconds]:
                self.wait(float(seconds), lambda: self.drive(tab, ref, int(g), [], z=0.5))
            case ["rests", g, *late]:
                self.drive(tab, ref, int(g), [word for word in late if word != "finally"], final="finally" in late)
            case ["shines", colour]:
                lights = Message(c.LIGHTS_SOLID.topic(ref), b'{"r": %s}' % colour.encode(), QoS.DELIVERED)
                if not self.drivers.accompany(tab, ref, c.LIGHTS_SOLID, lights):
                    self._publish(lights.topic, lights.payload)
            case ["releases"]:
                self.drivers.release(tab, ref)
            case ["leaves"] | ["out"]:
                del self.tabs[who]
                self.drivers.closed(tab, for_good=what == ["out"])
            case ["stalls"]:  # its connection hangs
                self.tabs[f"{who} before"] = self.tabs.pop(who)
            case ["copies", whose]:
                self.drivers.restore(self.tokens[whose], tab)
            case ["sees"]:
                self.happened += self.seen(self.drivers.robot(ref).shown(tab, self.now))

    # -- parts

    def note(self, what: str) -> None:
        self.happened.append(what)

    def grant(self) -> None:
        self.granted += 1

    def connect(self, who: str, token: str = "") -> Tab:
        tab = self.tabs[who] = Tab(f"token {next(self._numbers)}", who, "desk")
        self.tokens[who] = tab.token
        self.echo(tab)
        self.drivers.restore(token, tab)
        return tab

    def echo(self, tab: Tab) -> None:
        """The page's clock shows the same time."""
        tab.clock.echo(tab.clock.ping(self.now), 1000 * self.now, self.now)

    def drive(self, tab: Tab, ref: str, g: int, late: list[str], *, z: float = 0.0, final: bool = False) -> None:
        age_s = float(late[1]) if late else 0.0
        _, why = self.drivers.drive(tab, DriveOp(ref=ref, g=g, t=1000 * (self.now - age_s), z=z, final=final), "")
        self.happened += [why] if why else []

    def wait(self, seconds: float, act: Any = lambda: None) -> None:
        for _ in range(round(seconds / STEP_S)):
            self.now += STEP_S
            for who, tab in self.tabs.items():
                if not who.endswith(" before"):
                    self.echo(tab)
            act()
            self.drivers.tick(self.now)
            self.settle()
        self.happened = [one for one, same in groupby(self.happened) for _ in (same if one != "go" else [one])]

    def settle(self) -> None:
        """Everything arrives: at robots, and what they answer here."""
        while True:
            arriving, self._arriving = self._arriving, []
            for base, robot in self.owners.items():
                mine = [message for message in arriving if message.topic.startswith(f"{base}/")]
                self.receive(robot.take(mine, self.now))
            if not self._arriving:
                return

    def receive(self, states: list[Message]) -> None:
        for state in states:
            base = state.topic.partition("/outgoing/")[0]
            self.views[base].receive(c.CONTROL_STATE, state, self.now, self.now)
            self.drivers.updated(base)

    def publish_capabilities(self, base: str, *, keeps: bool) -> None:
        drive = {"available": True, "controls": True} | ({"control": True} if keeps else {})
        value = {"drive": drive, "estop": {"available": True, "owners": ["serial"]}}
        payload = json.dumps({"schema": "pebble-capabilities/v1", "t": 1, "value": value}).encode()
        message = Message(c.CAPABILITIES.topic(base), payload, QoS.DELIVERED, True)
        self.views[base].receive(c.CAPABILITIES, message, self.now, self.now)
        self.drivers.updated(base)

    def ask_as_stranger(self, ref: str, want: str) -> None:
        request = {"id": STRANGER, "by": "eve", "want": "release" if want == "releases" else "hold"}
        topic = (c.CONTROL_TAKE if want == "takes" else c.CONTROL).topic(ref)
        self._arriving.append(Message(topic, json.dumps(request).encode()))

    def seen(self, view: DriverView) -> list[str]:
        words = ["you" if view.you else view.by, "asking" * view.asking, f"{view.asks} asks" * bool(view.asks)]
        return [*filter(None, words), *["no control"] * (not view.keeps)]

    def _publish(self, topic: str, payload: bytes, *, qos: QoS = QoS.DELIVERED, by: str = "", **_more: Any) -> bool:
        if not self.accepts:
            return False
        base, _, metric = topic.partition("/incoming/")
        members = {metric: payload}
        if metric == c.GROUP.metric:
            members = {member.metric: member.payload for member in groups.decode(payload)}
        self._arriving += [Message(f"{base}/incoming/{one}", raw, qos) for one, raw in members.items()]
        if lights := members.get(c.LIGHTS_SOLID.metric):
            self.happened.append(f"{'with ' * (len(members) > 1)}light {json.loads(lights)['r']}")
        if payload := members.get(c.DRIVE.metric, b""):
            drive = codec.decode(c.DRIVE, payload)
            self.sent.append((base, drive, qos))
            keyed = self.views[base].controlled and self.drivers.robot(base).client is not None
            kind = "go" if drive.moves else "final" if drive.valid_ms == 0 else "zero"
            assert drive.valid_ms == {"go": WIDE.valid_ms, "final": 0, "zero": UNSET}[kind] or self.views[base].link
            lost = keyed and kind != "final" and drive.key != self.owners[base].owners[0].lease.key
            where = ("fred " if base == FRED else "") + "grouped " * (metric == c.GROUP.metric and len(members) == 1)
            self.happened.append(where + kind + (" without key" if lost else ""))
        return True


KINDS = {"none": False, "keeps": True}


@pytest.fixture(params=KINDS)
def world(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> World:
    world = World(keeps=KINDS[request.param])
    monkeypatch.setattr(module, "clock", lambda: world.now)
    return world


#: They are the same whether or not the robot keeps control.
HISTORIES = {
    # -- lights
    "lights travel with the next command, and again by themselves": """
        robot takes groups
        ann shines 1: light 1
        ann takes
        ann drives 1: go
        ann shines 2
        ann shines 3
        wait 0.05
        ann drives 1: with light 3, go
        wait 0.05
        ann drives 1: go
        ann goes on 1 for 1.5: go, light 3, go""",
    "a zero goes before the lights, and alone": """
        robot takes groups
        ann takes
        ann drives 1: go
        ann shines 2
        ann rests 1: zero, light 2
        ann drives 2: go
        ann shines 3
        wait 0.2
        stop: final, light 3""",
    "lights of a page that does not drive are newer than those that wait": """
        robot takes groups
        ann takes
        ann drives 1: go
        ann shines 2
        ben shines 4: light 4
        wait 0.05
        ann drives 1: go
        ann rests 1: zero""",
    "after a group a zero goes in the topic of groups, too": """
        robot takes groups
        ann takes
        ann drives 1: go
        ann shines 2
        wait 0.05
        ann drives 1: with light 2, go
        ann rests 1: zero, grouped zero, light 2
        ann drives 2: go
        ann rests 2: zero""",
    # -- gestures
    "a gesture moves and its release stops": """
        ann takes
        ann drives 1: go
        moved: ann
        wait 0.05
        ann rests 1: zero
        moved: nobody
        ann drives 1: Let go first""",
    "each gesture has a greater number": """
        ann takes
        ann drives 5: go
        ann rests 5: zero
        ann drives 4: Let go first
        ann drives 6: go""",
    "a final zero of who drives stays final": """
        ann takes
        ann drives 1: go
        ann rests 1 finally: final
        ann drives 1: Let go first""",
    "a gesture whose end was lost ends with the next one": """
        ann takes
        ann drives 1: go
        wait 0.05
        ann drives 2: final, Let go first
        ann drives 2: Let go first
        ann drives 3: go""",
    "a silent gesture ends with a final zero that is repeated": """
        ann takes
        ann drives 1: go
        wait 0.25
        wait 0.05: final
        wait 0.25: final, final
        wait 2
        ann drives 1: Let go first""",
    "commands that come after a silence move nothing, also if this process stood still": """
        ann takes
        ann drives 1: go
        freeze 0.3
        ann drives 1: final, Let go first
        ann drives 1: Let go first
        ann drives 2: go""",
    "a command that is too old ends the gesture": """
        ann takes
        ann drives 1: go
        wait 0.05
        ann drives 1 late 0.61: final, Commands are late
        ann drives 1: Let go first""",
    "a page that answers no ping moves nothing": """
        ann takes
        freeze 1.1
        ann drives 1: The connection to the page is stalled""",
    "a zero is forwarded however old it is": """
        ann takes
        ann drives 1: go
        freeze 2
        ann rests 1 late 1.9: zero""",
    "a zero is forwarded without control and without gesture": """
        ann rests 0: final
        eve rests 7 finally: final""",
    "a zero of a gesture before ends none": """
        ann takes
        ann drives 2: go
        ann rests 1: zero
        wait 0.05
        ann drives 2: go""",
    "a robot that may not move does not": """
        ann takes
        ann drives 1: go
        wait 0.05
        blocked Stopped
        ann drives 1: final, Stopped
        blocked
        ann drives 1: Let go first
        ann drives 2: go""",
    "zeros that are repeated end when a gesture begins": """
        ann takes
        ann drives 1: go
        stop: final
        ann drives 2: go
        ann goes on 2 for 0.4: go""",
    "zeros that a frozen server did not repeat are not sent later": """
        stop: final
        freeze 3
        wait 1""",
    "a command that the broker does not take ends the gesture": """
        ann takes
        deaf
        ann drives 1: The server cannot reach the broker
        hears
        ann drives 1: Let go first
        wait 0.3: final, final
        ann drives 2: go""",
    # -- stops
    "a stop ends the gesture that moves the robot": """
        ann takes
        ann drives 1: go
        stop: final
        wait 0.05
        ann drives 1: Let go first
        ann drives 2: go""",
    "a stop is forwarded to what says that it does not drive": """
        robot drives not
        stop: final
        robot tells nothing
        stop: final""",
    # -- control
    "without control nothing moves": """
        ann drives 1: Take control to drive
        eve takes
        ann drives 2: eve is driving
        eve drives 1: go
        eve goes on 1 for 6: go
        ann drives 3: eve is driving""",
    "taking over stops who drove": """
        ann takes
        ann drives 1: go
        bob takes over: final
        bob sees: you
        ann sees: bob
        wait 0.05
        ann drives 1: Let go first
        ann drives 2: bob is driving
        bob drives 1: go
        bob goes on 1 for 0.4: go""",
    "what is held when control comes moves nothing": """
        ann drives 1: Take control to drive
        ann takes
        ann drives 1: Let go first
        ann drives 2: go""",
    "who gives control back drives no more": """
        ann takes
        ann drives 1: go
        ann releases: final
        ann sees
        ann drives 2: Take control to drive
        bob takes
        bob sees: you""",
    "control ends after a minute without a gesture": """
        ann takes
        wait 59
        ann sees: you
        wait 2
        ann sees
        ann drives 1: Take control to drive""",
    "who has no name does not get control of a robot that takes names": """
        robot takes names
        ann takes: goob takes commands with names only
        ann drives 1: Take control to drive""",
    # -- several robots
    "who takes another robot moves the first one no more": """
        ann takes
        ann drives 1: go
        ann takes fred: final
        ann drives 1 fred: Let go first
        ann drives 2 fred: fred go
        ann sees: you
        ann sees fred: you""",
    "one gesture moves one robot": """
        ann takes
        ann takes fred
        ann drives 1: go
        ann drives 1 fred: final, Let go first
        ann drives 2 fred: fred go""",
    "a zero for another robot stops what the gesture moves": """
        ann takes
        ann takes fred
        ann drives 1: go
        ann rests 1 fred: fred zero, final
        ann drives 1: Let go first""",
    # -- connections
    "a page that connects again has control but no gesture": """
        ann takes
        ann drives 1: go
        ann leaves: final
        wait 1: final, final
        ann returns
        ann sees: you
        wait 0.05
        ann drives 1: go""",
    "a token is valid once": """
        ann takes
        ann leaves
        eve copies ann
        eve sees: you
        eve leaves
        bob copies ann
        bob sees""",
    "a token is void while its connection lives": """
        ann takes
        eve copies ann
        eve sees: ann
        ann drives 1: go
        eve drives 1: ann is driving""",
    "a connection that hangs ends when its page comes back": """
        ann takes
        ann drives 1: go
        ann stalls
        freeze 1.2
        ann returns: final
        ann sees: you
        ann drives 1: go""",
    "a page is awaited for five seconds": """
        ann takes
        ann leaves
        wait 4.9
        ann returns
        ann sees: you
        ann leaves
        wait 5.1
        ann returns
        ann sees""",
    "a page that gave control back is not awaited": """
        ann takes
        ann releases
        ann leaves
        ann returns
        ann sees""",
    "control that was taken meanwhile does not come back": """
        ann takes
        ann leaves
        eve takes
        eve drives 1: go
        ann returns
        ann sees: eve""",
    "a user who lost the right has nothing to come back to": """
        ann takes
        ann drives 1: go
        ann out: final
        ann returns
        ann sees""",
}
SERVER_GIVES = {
    "who has just driven is not asked but named": """
        ann takes
        bob takes: ann is driving
        bob sees: ann, no control
        wait 4.9
        bob takes: ann is driving
        wait 0.2
        bob takes
        bob sees: you, no control""",
    "a robot that begins to keep control asks all anew": """
        ann takes
        ann drives 1: go
        robot keeps control: final
        ann sees
        ann takes
        ann drives 2: go""",
    "control that the server gave does not outlast the wait": """
        ann takes
        ann leaves
        robot keeps control
        stranger takes
        ann returns
        ann sees: eve""",
}
ROBOT_GIVES = {
    "who drives is asked and may let others drive": """
        ann takes
        ann drives 1: go
        bob takes
        bob sees: ann, asking, bob asks
        ann sees: you, bob asks
        ann releases: final
        wait 1.1: final, final
        bob sees: you
        ann sees: bob""",
    "who asks and leaves asks no more": """
        ann takes
        bob takes
        bob leaves
        ann sees: you""",
    "who has it by another server is asked": """
        stranger takes
        ann sees: eve
        moved: eve
        ann drives 1: eve is driving
        ann takes
        ann sees: eve, asking, ann asks
        stranger releases
        wait 1.1
        ann sees: you""",
    "another server takes over": """
        ann takes
        ann drives 1: go
        stranger takes: final
        ann sees: eve
        ann drives 1: Let go first
        ann drives 2: eve is driving""",
    "a motor owner that is started again needs a new gesture": """
        ann takes
        ann drives 1: go
        robot restarts: final
        wait 0.3: final, final
        ann sees: you
        ann drives 1: Let go first
        ann drives 2: go""",
    "a robot that keeps control no more has taken it away": """
        ann takes
        ann drives 1: go
        robot keeps nothing: final
        ann sees: no control""",
    "a robot that was forgotten has taken it away": """
        ann takes
        ann drives 1: go
        robot forgotten: final
        ann sees: no control""",
    "what is given back counts as this server's until the robot has taken note": """
        ann takes
        robot silent
        ann releases
        bob sees
        wait 2.2
        bob sees: ann
        wait 1
        bob sees""",
}


@pytest.mark.parametrize("history", HISTORIES)
def test_histories(world: World, history: str) -> None:
    text = HISTORIES[history]
    if not world.views[GOOB].controlled:  # the page says so
        lines = (
            f"{line}{', ' if ': ' in line else ': '}no control" if " sees" in line else line
            for line in text.splitlines()
        )
        text = "\n".join(lines)
    world.tell(text)


@pytest.mark.parametrize("history", SERVER_GIVES)
@pytest.mark.parametrize("world", ["none"], indirect=True)
def test_histories_of_a_robot_that_keeps_no_control(world: World, history: str) -> None:
    world.tell(SERVER_GIVES[history])


@pytest.mark.parametrize("history", ROBOT_GIVES)
@pytest.mark.parametrize("world", ["keeps"], indirect=True)
def test_histories_of_a_robot_that_keeps_control(world: World, history: str) -> None:
    world.tell(ROBOT_GIVES[history])


# -- more than a history says


@pytest.mark.parametrize(("level", "qos"), [("wide", 1), ("narrow", 0), ("thin", 0)])
@pytest.mark.parametrize("world", ["none"], indirect=True)
def test_a_link_thins_out_what_moves_and_nothing_that_stops(world: World, level: LinkLevel, qos: int) -> None:
    wanted = LEVELS[level]
    world.views[GOOB].link = LinkState(level=level, drive_hz=wanted.drive_hz, rtt_ms=9, queue_ms=0, t=1)
    world.tell("ann takes")
    times: list[object] = []
    for _ in range(40):
        before = len(world.sent)
        world.perform(["ann", "drives", "1"])
        times += [round(1000 * world.now) if wanted.stamped else UNSET] * (len(world.sent) - before)
        world.now += STEP_S
        world.echo(world.tabs["ann"])
    assert len(world.sent) == 2 * wanted.drive_hz
    assert {(sent_qos, drive.valid_ms) for _, drive, sent_qos in world.sent} == {(qos, wanted.valid_ms)}
    assert [drive.t for _, drive, _ in world.sent] == times
    keys = {drive.key for _, drive, _ in world.sent}
    assert (len(keys), UNSET in keys) == (1, not wanted.stamped)
    world.drivers.renew_keys()
    world.perform(["ann", "drives", "1"])
    assert (world.sent[-1][1].key in keys) == (not wanted.stamped)
    world.sent.clear()
    world.tell("ann rests 1: zero\n stop: final")
    assert {sent_qos for _, _, sent_qos in world.sent} == {QoS.DELIVERED}


def test_only_a_page_with_control_moves_and_what_ends_motion_halts() -> None:
    for (state, event), step in TABLE.items():
        assert step.halts == (state is State.MOVING and event is not Event.LETS_GO), (state, event)
        assert (step.state is State.MOVING) == (event is Event.MOVES), (state, event)
        assert (step.state is State.FREE) == (event in (Event.ENDED, Event.LOST)), (state, event)
    assert {event for state, event in TABLE if state is State.FREE} == {Event.GIVEN}


def test_a_page_has_sixteen_robots_at_most(world: World) -> None:
    bases, refused = [f"pebble/robots/r{number}" for number in range(MOST_WISHES + 1)], list[str]()
    tab = world.connect("ann")

    def take(base: str) -> int:
        world.drivers.take(tab, world.views[base], lambda: None, refused.append, over=False)
        world.settle()
        return len(refused)

    for base in bases:
        world.views[base], world.owners[base] = RobotView(base), KeepingRobot(base)
        world.publish_capabilities(base, keeps=world.views[GOOB].controlled)
    assert sum(map(take, [*bases[:-1], bases[0]])) == 0
    assert take(bases[-1]) == 1
    assert refused == ["This page has control of 16 robots: release one"]
    world.drivers.release(tab, bases[0])
    world.wait(0.2)
    assert take(bases[-1]) == 1


def test_pages_are_told_whenever_who_drives_changes(world: World) -> None:
    world.wait(STEP_S)
    for line, tells in (
        ("ann takes", True), ("ann drives 1: go", True), ("wait 0.05", False), ("ann drives 1: go", False),
        ("ann rests 1: zero", True), ("ann rests 1: zero", False), ("bob takes over", True), ("bob releases", True),
    ):  # fmt: skip
        world.marked.clear()
        world.tell(line)
        assert world.marked == ({GOOB} if tells else set()), line


def test_who_gets_and_gives_control_and_moves_wheels_is_known_for_the_audit(world: World) -> None:
    world.tell("ann takes\n ann takes over")
    assert world.granted == (1 if world.views[GOOB].controlled else 2)
    ann, bob = world.tabs["ann"], world.connect("bob")
    drive = lambda g, z: world.drivers.drive(ann, DriveOp(ref=GOOB, g=g, t=1000 * world.now, z=z), "")
    assert [drive(1, 0.5), drive(1, 0.5), drive(1, 0.0)] == [(True, ""), (False, ""), (False, "")]
    assert drive(1, 0.5) == (False, "Let go first")
    world.perform(["deaf"])
    assert drive(2, 0.5) == (False, "The server cannot reach the broker")
    assert [world.drivers.release(tab, GOOB) for tab in (bob, ann, ann)] == [False, True, False]


def test_of_a_robot_that_rests_nothing_is_remembered(world: World) -> None:
    world.tell("ann takes\n ann drives 1: go\n ann leaves: final")
    before = world.drivers.robot(GOOB)
    world.wait(4.9)
    assert world.drivers.robot(GOOB) is before
    world.wait(0.2)
    assert world.drivers.robot(GOOB) is not before


def test_a_server_that_ends_stops_what_its_pages_move(world: World) -> None:
    world.tell("ann takes\n ann drives 1: go\n bob takes fred\n bob drives 1 fred: fred go")
    world.happened = []
    world.drivers.closed_all()
    world.settle()
    assert world.happened == ["final", "fred final"]
    assert [owner.owners[0].by for owner in world.owners.values()] == ["", ""]


def test_how_long_who_has_control_has_rested_is_shown(world: World) -> None:
    world.tell("ann takes\n ann drives 1: go")
    assert world.drivers.robot(GOOB).shown(world.tabs["ann"], world.now).idle_s is None
    world.tell("ann rests 1: zero\n wait 2")
    view = world.drivers.robot(GOOB).shown(world.tabs["ann"], world.now)
    assert view.idle_s == pytest.approx(2)
    assert view.device == "desk"
