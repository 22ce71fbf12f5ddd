"""What an emergency stop sends, when, and when it counts as confirmed."""

from __future__ import annotations

import json
from itertools import pairwise

import pytest

from pebble.extensions.operator.client import estop
from pebble.extensions.operator.client.estop import MAX_ROBOTS, Progress, StopSender, new_name, send
from pebble.transports import Message, QoS
from tests.ext.operator.client.estop_robot import Owner, Robot, capabilities, outgoing

GOOB, FRED = "pebble/robots/goob", "pebble/robots/fred"
ESTOP, DRIVE = f"{GOOB}/incoming/estop", f"{GOOB}/incoming/drive-values"


def sender(*robots: str, hold: bool = False, by: str = "ann@desk", why: str = "") -> StopSender:
    return StopSender(new_name(), by=by, why=why, now=0.0, robots=robots or None, hold=hold)


def receive(stop: StopSender, *messages: Message, now: float) -> None:
    for message in messages:
        stop.receive(message, now)


def topics(messages: list[Message]) -> list[str]:
    return [message.topic for message in messages]


def sent_times(stop: StopSender, until: float) -> list[float]:
    """When ``stop`` publishes, called exactly when it is due."""
    times = []
    while stop.due is not None and stop.due <= until:
        now = stop.due
        if stop.tick(now):
            times.append(now)
    return times


def test_the_first_stop_needs_nothing_from_the_robot() -> None:
    stop = sender(GOOB, why="dog")
    first = stop.tick(0.0)
    assert topics(first) == [ESTOP, DRIVE]
    assert json.loads(first[0].payload) == {"stop": stop.order.name, "by": "ann@desk", "why": "dog"}
    assert json.loads(first[1].payload) == {"x": 0, "z": 0, "y": 0, "valid_ms": 0}
    assert [(message.qos, message.retain) for message in first] == [(1, False), (1, False)]
    assert (stop.tick(0.1), stop.due) == ([], 0.5)


def test_it_is_confirmed_by_every_owner_and_then_silent() -> None:
    stop, robot = sender(GOOB), Robot(GOOB, "left", "right")
    receive(stop, robot.capabilities(), now=0.01)
    left, right = robot.take(stop.tick(0.01))
    receive(stop, left, now=0.1)
    assert stop.robots[GOOB].why == "right has not confirmed"
    assert (stop.confirmed, stop.finished) == (False, False)
    receive(stop, right, now=0.125)
    assert (stop.robots[GOOB].progress, stop.robots[GOOB].confirmed_s) == (Progress.CONFIRMED, 0.125)
    assert (stop.confirmed, stop.finished, stop.due, stop.tick(9.0)) == (True, True, None, [])


def test_states_may_arrive_before_capabilities() -> None:
    stop, robot = sender(GOOB), Robot(GOOB, "serial")
    receive(stop, *robot.take(stop.tick(0.0)), now=0.1)
    assert stop.robots[GOOB].why == "it has not published its capabilities"
    receive(stop, robot.capabilities(), now=0.2)
    assert stop.confirmed


def test_the_retained_state_of_an_earlier_stop_confirms_nothing() -> None:
    stop, robot = sender(GOOB), Robot(GOOB, "serial")
    robot.take(sender(GOOB).tick(0.0))
    receive(stop, robot.capabilities(), robot.owners[0].state(retain=True), now=0.1)
    assert robot.owners[0].latch.latched
    assert stop.robots[GOOB].why == "serial has not confirmed: it may be off"
    assert sent_times(stop, 2.0) == [0.1, 0.6, 1.1, 1.6]


def test_an_owner_that_cannot_save_confirms_all_the_same() -> None:
    stop, robot = sender(GOOB), Robot(GOOB, "mcu", persisted=None)
    receive(stop, robot.capabilities(), *robot.take(stop.tick(0.0)), now=0.1)
    assert (stop.confirmed, stop.robots[GOOB].saved, stop.finished) == (True, False, True)


def test_it_goes_on_until_the_state_is_on_disk() -> None:
    stop, robot = sender(GOOB), Robot(GOOB, "serial", persisted=False)
    receive(stop, robot.capabilities(), *robot.take(stop.tick(0.0)), now=0.1)
    assert (stop.confirmed, stop.robots[GOOB].saved, stop.finished) == (True, False, False)
    assert topics(stop.tick(0.6)) == [ESTOP, DRIVE]
    assert robot.owners[0].latch.count == 1
    robot.owners[0].persisted = True
    receive(stop, robot.owners[0].state(), now=0.7)
    assert (stop.confirmed, stop.robots[GOOB].saved, stop.finished) == (True, True, True)


def test_under_a_flood_of_stops_an_obeyed_one_is_confirmed_and_a_restart_before_it_is_saved_repeats_it() -> None:
    """Each new stop has to be saved again, and takes the place of an older name."""
    stop, robot = sender(GOOB), Robot(GOOB, "left", "right", persisted=False)
    left, right = robot.take(stop.tick(0.0))
    receive(stop, robot.capabilities(), left, now=0.1)
    for _ in range(20):
        robot.take(sender(GOOB).tick(0.0))
    receive(stop, robot.owners[0].state(), right, now=0.2)
    assert (stop.confirmed, stop.robots[GOOB].saved, stop.finished) == (True, False, False)
    robot.owners[0] = Owner(GOOB, "left", boot="ffffffff", persisted=True)
    receive(stop, robot.owners[0].state(), now=0.3)
    assert (stop.confirmed, stop.robots[GOOB].unconfirmed) == (False, ["left"])
    assert topics(stop.tick(0.8)) == [ESTOP, DRIVE]


def test_a_robot_that_never_answers_is_given_up_after_a_minute_unless_the_stop_is_held() -> None:
    stop, held = sender(GOOB), sender(GOOB, hold=True)
    times = sent_times(stop, 100.0)
    assert (len(times), times[0], times[-1]) == (120, 0.0, 59.5)
    assert sent_times(held, 100.0) == [number / 2 for number in range(201)]
    assert (stop.finished, stop.confirmed, stop.tick(61.0)) == (True, False, [])
    assert stop.robots[GOOB].progress is Progress.NOT_CONFIRMED
    assert stop.robots[GOOB].why == "nothing was received: it may be off"


SCRIPT, ROS, FREDS = f"{GOOB}/incoming/autonomy-command", f"{GOOB}/incoming/ros/drive", f"{FRED}/incoming/drive-values"
DRIVES, ELSEWHERE, BOTH = {"available": True}, {"available": True, "topic": "else/where"}, [ESTOP, DRIVE]
HELD_BY_NONE = {"zeros": [ROS, 5, FREDS]}
OLD, NO_OWNERS = "it has no emergency stop", "its capabilities list no valid motor owners"
ZEROS, REFUSED = (
    "it has motors that no stop can hold: they get zeros",
    "its broker refuses emergency stops, so it gets zeros",
)
#: What a robot publishes after the first stop that it got, where the next two go, and why it is never confirmed.
UNCONFIRMED: dict[str, tuple[dict[str, object], list[str], list[str], str]] = {
    "old": ({"drive": ELSEWHERE, "autonomy": {"command_topic": "a/s"}}, ["a/s", "else/where"], ["else/where"], OLD),
    "old, as its section is none": ({"drive": DRIVES, "estop": 5}, [SCRIPT, DRIVE], [DRIVE], OLD),
    "with a topic of another robot": ({"drive": {"topic": FREDS}}, [SCRIPT, DRIVE], [DRIVE], OLD),
    "with a script of another robot": ({"autonomy": {"command_topic": FREDS}}, [SCRIPT, DRIVE], [DRIVE], OLD),
    "not driving, but named": ({"drive": {"available": False}}, [SCRIPT, DRIVE], [DRIVE], OLD),
    "refused by its broker": ({"estop": {"available": False}}, BOTH, BOTH, REFUSED),
    "without a stop, beside ROS": (
        {"estop": {"available": False} | HELD_BY_NONE},
        [ESTOP, SCRIPT, DRIVE, ROS],
        [ESTOP, DRIVE, ROS],
        ZEROS,
    ),
    "with a stop, beside ROS": (
        {"estop": {"available": True, "owners": ["serial"]} | HELD_BY_NONE},
        [ESTOP, SCRIPT, DRIVE, ROS],
        [ESTOP, DRIVE, ROS],
        ZEROS,
    ),
    **{
        f"owners {owners}, topic {topic}": (
            {"drive": {"topic": topic}, "estop": {"available": True, "owners": owners}},
            BOTH,
            BOTH,
            NO_OWNERS,
        )
        for owners, topic in (([], None), (["a/b"], "a/#"), (["x"] * 17, 5), ("serial", ""))
    },
}


@pytest.mark.parametrize(("value", "next_", "later", "why"), UNCONFIRMED.values(), ids=UNCONFIRMED)
def test_what_cannot_confirm_a_stop_gets_it_or_zeros_for_a_minute(
    value: dict[str, object], next_: list[str], later: list[str], why: str
) -> None:
    stop, robot = sender(GOOB), Robot(GOOB, "serial")
    first = stop.tick(0.0)
    receive(stop, capabilities(GOOB, value), *robot.take(first), now=0.1)
    assert stop.due == 0.1, "its capabilities may name other topics"
    second = stop.tick(0.1)
    assert [topics(first), topics(second), topics(stop.tick(0.6))] == [[ESTOP, DRIVE], next_, later]
    ends = [message.payload for message in second if message.topic in (SCRIPT, "a/s")]
    assert set(ends) <= {b'{"action":"stop"}'}
    assert stop.robots[GOOB].why == why
    assert sent_times(stop, 100.0)[-1] == pytest.approx(59.6)
    assert stop.robots[GOOB].progress is (Progress.OLD if why == OLD else Progress.NOT_CONFIRMED)
    assert (stop.finished, stop.confirmed) == (True, False)


@pytest.mark.parametrize(
    ("topic", "sent"), [("else/where", False), (f"{GOOB}/incoming/steer", True), (f"{GOOB}/incoming/", False)]
)
def test_a_page_sends_zeros_to_incoming_topics_of_that_robot_only(topic: str, *, sent: bool) -> None:
    stop = StopSender(new_name(), by="ann", why="", now=0.0, robots=[GOOB], own_only=True)
    receive(stop, capabilities(GOOB, {"drive": {"available": True, "topic": topic}}), now=0.0)
    assert (topic in topics(stop.tick(0.0))) is sent


#: What may wrongly be taken for something that does not drive, and how often a stop of all is sent to it in 2 s.
MOVERS: dict[str, tuple[Message, int]] = {
    "a board of the original": (outgoing(GOOB, "online", {"t": 1, "subscribes": ["incoming/drive-values"]}), 4),
    "another type": (outgoing("pebble/lamps/mini", "online", {"t": 1}), 4),
    "driving without a stop": (capabilities(GOOB, {"drive": {"available": True}}), 4),
    "no capabilities": (outgoing(GOOB, "online", {"t": 1}), 4),
    "an unknown section": (capabilities(GOOB, {"arm": {"available": True}}), 4),
    "a drive section that is none": (capabilities(GOOB, {"drive": ["x"], "estop": 5}), 4),
    "capabilities that are none": (outgoing(GOOB, "capabilities", [1]), 4),
    "no driving, with a stop": (
        capabilities(GOOB, {"drive": {"available": False}, "estop": {"available": True, "owners": ["arm"]}}),
        4,
    ),
    "ROS beside it": (capabilities(GOOB, {"drive": {"available": True}, "estop": {"zeros": [DRIVE]}}), 4),
    "it says that it does not drive": (capabilities(GOOB, {"drive": {"available": False}, "estop": {}}), 1),
}


@pytest.mark.parametrize(("message", "times"), MOVERS.values(), ids=MOVERS)
def test_a_stop_of_all_reaches_what_may_move(message: Message, times: int) -> None:
    stop = sender()
    receive(stop, message, now=0.0)
    base = message.topic.partition("/outgoing/")[0]
    sent = [topics(stop.tick(now)) for now in (0.0, 0.5, 1.0, 1.5)]
    assert sum(f"{base}/incoming/drive-values" in some for some in sent) == times


def test_named_robots_are_all_stopped_however_many() -> None:
    bases = [f"pebble/robots/r{number}" for number in range(MAX_ROBOTS + 5)]
    assert len(sender(*bases).tick(0.0)) == 2 * len(bases)


def test_who_and_why_are_cut_and_made_harmless() -> None:
    stop = sender(GOOB, by="ann\x1b[31m@" + "d" * 50, why='say "stop" ' + "é" * 50)
    body = json.loads(stop.tick(0.0)[0].payload)
    assert (len(body["by"]), len(body["why"])) == (32, 40)
    assert body["by"].startswith("ann?[31m@d")
    assert body["why"].startswith("say ?stop? ?")
    assert len(stop.tick(0.5)[0].payload) < 128


# -- all robots


def test_all_robots_are_stopped_as_they_are_found_for_five_seconds() -> None:
    stop = sender()
    assert (stop.tick(0.0), stop.due) == ([], 5.0)
    receive(stop, outgoing(GOOB, "online", {"t": 1}), now=0.2)
    assert stop.due == 0.2
    assert topics(stop.tick(0.2)) == [ESTOP, DRIVE]
    receive(stop, outgoing(FRED, "front-camera", "a picture"), now=4.9)
    assert topics(stop.tick(4.9)) == [ESTOP, DRIVE, f"{FRED}/incoming/estop", f"{FRED}/incoming/drive-values"]
    receive(stop, outgoing("pebble/robots/late", "online", {"t": 1}), now=5.1)
    assert list(stop.robots) == [GOOB, FRED]


def test_all_ends_when_all_are_confirmed_but_not_before_the_five_seconds() -> None:
    stop, robot = sender(), Robot(GOOB, "serial")
    receive(stop, robot.capabilities(), now=0.1)
    receive(stop, *robot.take(stop.tick(0.1)), now=0.2)
    assert (stop.confirmed, stop.finished, stop.due) == (True, False, 5.0)
    stop.tick(5.0)
    assert stop.finished


def test_a_component_that_does_not_drive_is_spared_once_that_is_known() -> None:
    stop = sender()
    receive(stop, outgoing(GOOB, "online", {"t": 1}), now=0.0)
    assert topics(stop.tick(0.0)) == [ESTOP, DRIVE]
    receive(stop, capabilities(GOOB, {"drive": {"available": False}}), now=0.1)
    assert (stop.tick(0.5), stop.robots[GOOB].progress) == ([], Progress.SPARED)
    receive(stop, capabilities(FRED, {"drive": {"available": False}}), now=0.6)
    assert topics(stop.tick(0.6)) == [f"{FRED}/incoming/autonomy-command", f"{FRED}/incoming/drive-values"]
    assert (stop.tick(1.2), stop.robots[FRED].progress) == ([], Progress.SPARED)
    assert not stop.confirmed, "no robot was stopped"


@pytest.mark.parametrize(
    "message",
    [
        Message("other/topic", b"1"),
        Message(f"{GOOB}/incoming/drive-values", b"{}"),
        Message(f"{GOOB}/outgoing/status", b"", retain=True),
        Message("pebble/servers/fair-1/outgoing/driving", b'{"t": 1, "robots": {}}'),
    ],
)
def test_what_no_robot_publishes_finds_none(message: Message) -> None:
    stop = sender()
    receive(stop, message, now=0.1)
    assert stop.robots == {}


HEARTBEAT = ("online", {"t": 1})
RETAINED = ("status", {})
CAPABILITIES = (
    "capabilities",
    {"t": 1, "value": {"drive": {"available": True}, "estop": {"available": True, "owners": ["serial"]}}},
)
STATE = ("estop/serial", Robot(GOOB, "serial").owners[0].latch.state(True))


def publish(stop: StopSender, base: str, bodies: list[tuple[str, object]], now: float) -> list[Message]:
    publish_quietly(stop, base, bodies, now)
    return stop.tick(now)


@pytest.mark.parametrize("hold", [False, True])
@pytest.mark.parametrize("published", [[HEARTBEAT], [RETAINED], [STATE, CAPABILITIES, HEARTBEAT]])
def test_a_crowd_of_strangers_keeps_the_stop_from_no_robot(
    monkeypatch: pytest.MonkeyPatch, published: list[tuple[str, object]], *, hold: bool
) -> None:
    """They publish for each of their components what the real robot publishes after them."""
    places, stop, sent = 30, sender(hold=hold), []
    monkeypatch.setattr(estop, "MAX_ROBOTS", places)
    for step in range(20):
        now = 0.25 * step
        for number in range(places + 6):
            publish_quietly(stop, f"pebble/robots/r{number}", published, now)
        messages = stop.tick(now) + publish(stop, GOOB, published, now)
        sent += [now] * (ESTOP in topics(messages))
    assert sent[0] == 0.0
    assert max(later - earlier for earlier, later in pairwise([*sent, 5.0])) <= 0.5
    assert len(sent) <= 10, "at most twice a second"
    assert (GOOB in stop.robots, len(stop.robots)) == (False, places)
    assert stop.omitted
    assert not stop.confirmed


def publish_quietly(stop: StopSender, base: str, bodies: list[tuple[str, object]], now: float) -> None:
    for metric, body in bodies:
        stop.receive(outgoing(base, metric, body, retain=metric == "status"), now)


def test_robots_without_a_place_get_the_stop_for_a_minute_however_many() -> None:
    stop, crowd = sender(), [f"pebble/robots/r{number}" for number in range(4 * MAX_ROBOTS)]
    for base in crowd:
        publish_quietly(stop, base, [HEARTBEAT], 0.0)
    assert {f"{base}/incoming/estop" for base in crowd} <= set(topics(stop.tick(0.0)))
    last = f"{crowd[-1]}/incoming/estop"
    sent = [last in topics(publish(stop, crowd[-1], [HEARTBEAT], now)) for now in (0.1, 0.6, 0.7, 59.0, 60.0)]
    assert (sent, stop.finished) == ([False, True, False, True, False], True)


@pytest.mark.parametrize("places", [0, 1])
def test_a_stop_that_is_ended_goes_to_no_robot_also_without_a_place(
    monkeypatch: pytest.MonkeyPatch, places: int
) -> None:
    monkeypatch.setattr(estop, "MAX_ROBOTS", places)
    stop = sender(hold=True)
    publish_quietly(stop, GOOB, [HEARTBEAT], 0.0)
    stop.end()
    assert (stop.finished, stop.due, stop.tick(0.5)) == (True, None, [])
    assert [robot.progress for robot in stop.robots.values()] == [Progress.NOT_CONFIRMED] * places


def test_robots_that_the_caller_knows_are_stopped_unheard_and_confirm_it_in_a_crowd() -> None:
    robot = Robot(GOOB, "serial")
    stop = StopSender(new_name(), by="", why="", now=0.0, robots=None, known=[GOOB])
    for number in range(MAX_ROBOTS + 5):
        publish_quietly(stop, f"pebble/robots/r{number}", [CAPABILITIES, HEARTBEAT], 0.1)
    first = stop.tick(0.1)
    assert topics(first)[:2] == [ESTOP, DRIVE]
    receive(stop, *robot.take(first[:1]), robot.capabilities(), now=0.3)
    assert stop.robots[GOOB].progress is Progress.CONFIRMED
    assert not stop.confirmed, "others are omitted"


def test_a_stop_that_is_refused_for_want_of_acknowledgements_is_sent_without_one() -> None:
    sent: list[tuple[str, QoS]] = []

    def refusing(topic: str, _payload: bytes, *, qos: QoS) -> bool:
        sent.append((topic, qos))
        return qos is QoS.LATEST

    send(refusing, sender(GOOB).tick(0.0))
    assert sent == [(topic, qos) for topic in (ESTOP, DRIVE) for qos in (QoS.DELIVERED, QoS.LATEST)]


# -- hold


def test_a_hold_stops_every_robot_that_comes_online_under_one_name() -> None:
    stop = sender(hold=True)
    assert (stop.tick(0.0), stop.due, stop.finished) == ([], None, False)
    robot = Robot(GOOB, "serial")
    receive(stop, outgoing(GOOB, "online", {"t": 1}), now=1000.0)
    first = stop.tick(1000.0)
    assert json.loads(first[0].payload)["stop"] == stop.order.name
    receive(stop, robot.capabilities(), *robot.take(first), now=1000.1)
    assert (stop.confirmed, stop.due, stop.finished) == (True, None, False)
    late = Robot(FRED, "mcu")
    receive(stop, late.capabilities(), now=5000.0)
    assert topics(stop.tick(5000.0)) == [f"{FRED}/incoming/estop", f"{FRED}/incoming/drive-values"]


def test_a_hold_stops_a_robot_again_that_has_lost_its_memory_and_no_other() -> None:
    stop, robot = sender(GOOB, hold=True), Robot(GOOB, "mcu", persisted=None)
    receive(stop, robot.capabilities(), *robot.take(stop.tick(0.0)), now=0.1)
    latch = robot.owners[0].latch
    latch.reset(latch.boot, latch.count, 0, 0)
    receive(stop, robot.owners[0].state(), now=10.0)
    assert stop.tick(10.0) == [], "reset on purpose"
    restarted = Robot(GOOB, "mcu", persisted=None)
    restarted.owners[0].latch.boot = "ffffffff"
    receive(stop, restarted.owners[0].state(), now=20.0)
    assert topics(stop.tick(20.0)) == [ESTOP, DRIVE]
    receive(stop, *restarted.take(stop.tick(20.5)), now=20.6)
    assert stop.robots[GOOB].confirmed_s == pytest.approx(0.6)


def test_more_holds_than_an_owner_remembers_names_come_to_rest() -> None:
    """Else each would take the place of another for ever, and a robot that is reset on purpose would not stay free."""
    stops, robot = [sender(GOOB, hold=True) for _ in range(9)], Robot(GOOB, "serial")
    for now in range(10):
        for stop in stops:
            states = robot.take(stop.tick(float(now)))
            for other in stops:
                receive(other, robot.capabilities(), *states, now=float(now))
    assert all(stop.confirmed for stop in stops)
    latch = robot.owners[0].latch
    assert latch.count == 9
    assert latch.reset(latch.boot, latch.count, 0, 0)
    for stop in stops:
        receive(stop, robot.owners[0].state(), now=20.0)
    assert [stop.tick(20.0) for stop in stops] == [[]] * 9


def test_states_that_change_quickly_do_not_make_it_send_more_often() -> None:
    stop, robot = sender(GOOB, hold=True), Robot(GOOB, "serial")
    robot.owners[0].latch.boot = "ffffffff"
    free = robot.owners[0].state()
    robot.owners[0].latch.boot = "00000000"
    receive(stop, robot.capabilities(), *robot.take(stop.tick(0.0)), now=0.1)
    latched = robot.owners[0].state()
    sent = 0
    for step in range(100):
        receive(stop, free, latched, free, now=0.2 + step / 100)
        sent += bool(stop.tick(0.2 + step / 100))
    assert sent == 2


def test_a_removed_value_is_no_sign_of_life() -> None:
    """Of an earlier name, say, which the robot itself removes."""
    stop = sender(GOOB)
    receive(stop, Message(f"{GOOB}/outgoing/online", b'{"t": 1, "online": false}', retain=True), now=0.1)
    for payload in (b"", b" "):
        receive(stop, Message(f"{GOOB}/outgoing/capabilities", payload), now=0.2)
        assert stop.robots[GOOB].is_gone
    receive(stop, Message(f"{GOOB}/outgoing/online", b'{"t": 2}'), now=0.3)
    assert not stop.robots[GOOB].is_gone
