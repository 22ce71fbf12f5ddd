"""What a bridge sends over a thin link, in virtual time, and that nothing is in a stop's way."""

import logging
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import pytest

from pebble.contract import LINK, codec
from pebble.contract.payloads import LinkState
from pebble.extensions.thin.uplink import RENEW_S
from pebble.transports import Outgoing
from tests.forwarding.virtual import World

LINK_STATE, ONLINE = "outgoing/link", "outgoing/online"
IMU = "outgoing/sensors/imu"
STATUS, STOPPED, CONTROL = "outgoing/status", "outgoing/estop/serial", "outgoing/control/serial"
EVENT, DRIVE, FLAG = "outgoing/somebody/happened", "incoming/drive-values", "incoming/flags/lamp"
MOVES, DATED = b'{"z": 0.5}', b'{"z": 0.5, "t": 1, "key": "0badf00d"}'
COMMANDS = {"late": [MOVES], "fresh": [MOVES], "dated": [DATED], "zeros": [b'{"z": 0}'], "rest": []}
LATE_S = {"late": 2.0, "fresh": 0.0, "dated": 2.0, "zeros": 2.0, "rest": 0.0}
FULL, FREE = Outgoing(waiting=100_000, round_trip_s=0.1), Outgoing(round_trip_s=0.1)
Start = Callable[..., World]


@pytest.fixture
def start(monkeypatch: pytest.MonkeyPatch) -> Start:
    def started(profile: str = "thin", link: dict[str, float] | None = None, **section: Any) -> World:
        world = World("bridge", monkeypatch)
        world.start(link={"profile": profile, **(link or {})}, **section)
        world.run()
        return world

    return started


def link_states(world: World) -> list[LinkState]:
    return [codec.decode(LINK, payload) for payload in world.remote.payloads(LINK_STATE)]


def stream(world: World, suffix: str, seconds: float, *, every_s: float = 0.02, qos: int = 1) -> int:
    """Publish numbers; returns the last one."""
    number = 0
    for number in range(round(seconds / every_s)):
        world.local.publish(suffix, b"%d" % number, qos=qos)
        world.run(every_s)
    return number


class TestLevels:
    @pytest.mark.parametrize(
        ("profile", "kbit", "level"), [("thin", {}, "thin"), ("auto", {}, "wide"), ("auto", {"kbit": 9.6}, "thin")]
    )
    def test_the_state_is_retained_from_the_start(
        self, start: Start, profile: str, kbit: dict[str, float], level: str
    ) -> None:
        world = start(profile, kbit)
        retained = world.retained(LINK_STATE)
        assert retained[0] is None, "it concerns the remote side alone"
        state = codec.decode(LINK, retained[1] or b"")
        assert (state.level, state.drive_hz) == (level, {"thin": 4, "wide": 20}[level])

    def test_it_is_published_on_change_and_else_rarely(self, start: Start) -> None:
        world = start()
        before = len(link_states(world))
        world.run(60)
        assert len(link_states(world)) - before == 6
        for number in range(100):
            world.uplink.answers(0.1 + 0.5 * (number % 2))
            world.run(0.5)
        states = link_states(world)[before + 6 :]
        assert 20 <= len(states) <= 26
        assert {(state.rtt_ms, state.queue_ms) for state in states[1:]} <= {(100, 0), (100, 500)}

    def test_while_a_queue_stands_operators_and_streams_send_less(self, start: Start) -> None:
        world = start()
        rates, samples = [], []
        for trip_s in (0.6, 2.0, 0.6):
            for _ in range(30):
                world.uplink.answers(trip_s)
                stream(world, IMU, 0.5)
            rates.append(link_states(world)[-1].drive_hz)
            samples.append(len(world.remote.on(IMU)) - sum(samples))
        assert rates == [4, 2.67, 4]
        assert samples[1] < samples[0] / 2 < samples[2]
        assert max(state.queue_ms for state in link_states(world)) == 1400

    def test_one_that_is_wide_again_takes_the_state_back(self, start: Start) -> None:
        world = start()
        world.stop()
        assert world.retained(LINK_STATE)[1]
        world.start()
        world.run(60)
        assert world.retained(LINK_STATE) == (None, None)


class TestHeartbeats:
    @pytest.mark.parametrize(
        ("profile", "section", "gap", "qos"),
        [
            ("auto", {}, 0.25, 1),
            ("thin", {}, 1.0, 0),
            ("thin", {"heartbeat": {"interval_seconds": 3}}, 3.0, 0),
            ("thin", {"remote": {"kind": "zenoh", "connect": ["tcp/host:7447"]}}, 1.0, 1),  # QoS 0 saves nothing there
        ],
    )
    def test_by_level(self, start: Start, profile: str, section: dict[str, Any], gap: float, qos: int) -> None:
        world = start(profile, **section)
        began = len(world.remote.on(ONLINE))
        world.run(30)
        arrived = world.remote.on(ONLINE)[began:]
        assert abs(len(arrived) - 30 / gap) <= 1
        assert {int(one.qos) for one in arrived} == {qos}

    def test_wait_last_and_come_as_soon_as_there_is_room(self, start: Start) -> None:
        world = start()
        world.uplink.way = FULL
        world.run(1)
        before = len(world.remote.on(ONLINE))
        world.run(5)
        assert len(world.remote.on(ONLINE)) == before
        world.uplink.way = FREE
        world.run(0.11)
        assert len(world.remote.on(ONLINE)) == before + 1


class TestStreams:
    def test_the_newest_of_each_second_passes_also_of_what_the_contract_does_not_know(self, start: Start) -> None:
        world, suffix = start(), "outgoing/programs/reading"
        last = stream(world, suffix, 10, qos=0)
        world.run(2)
        numbers = [int(payload) for payload in world.remote.payloads(suffix)]
        assert len(numbers) in (10, 11)
        assert numbers[-1] == last, "and the very last one"
        assert numbers == sorted(numbers)

    def test_at_a_level_that_is_wide_again_all_pass_at_once(self, start: Start) -> None:
        world = start("auto")
        for trip_s, pings in ((0.02, 5), (0.5, 4)):
            for _ in range(pings):
                world.uplink.answers(trip_s)
                world.run(0.5)
        world.uplink.way = FULL
        world.run(0.2)
        world.local.publish(STATUS, b"waits", retain=True)
        world.local.publish(EVENT, b"waits")
        world.run(0.2)
        assert not world.remote.on(EVENT)
        for _ in range(170):
            world.uplink.answers(0.02)
            world.run(0.5)
        assert link_states(world)[-1].level == "wide"
        assert (world.retained(STATUS)[1], world.remote.payloads(EVENT)) == (b"waits", [b"waits"])
        assert stream(world, IMU, 1) == 49
        assert len(world.remote.on(IMU)) == 50


class TestNoRoom:
    def test_what_waits_and_what_never_does(self, start: Start) -> None:
        world = start()
        world.local.publish(STATUS, b"0", retain=True)
        world.run()
        world.uplink.way = FULL
        world.run(0.2)
        for number in range(1, 4):
            for suffix in (STATUS, STOPPED, CONTROL, FLAG, IMU, EVENT):
                retain = suffix in (STATUS, STOPPED, CONTROL, FLAG)
                world.local.publish(suffix, b"%d" % number, retain=retain)
            world.run(0.5)
        passed = {suffix: world.remote.payloads(suffix) for suffix in (STATUS, STOPPED, CONTROL, FLAG, IMU, EVENT)}
        numbers = [b"1", b"2", b"3"]
        assert passed == {STATUS: [b"0"], STOPPED: numbers, CONTROL: numbers, FLAG: numbers, IMU: [], EVENT: []}
        world.uplink.way = FREE
        world.run(0.2)
        passed = {suffix: world.remote.payloads(suffix) for suffix in (STATUS, IMU, EVENT)}
        assert passed == {STATUS: [b"0", b"3"], IMU: [b"3"], EVENT: numbers}, "the newest value, and each event"

    def test_it_is_counted_and_logged_once_a_minute(self, start: Start, caplog: pytest.LogCaptureFixture) -> None:
        caplog.set_level(logging.WARNING)
        world = start()
        world.uplink.way = FULL
        stream(world, IMU, 10)
        assert world.service.dropped()["shed"] > 400
        assert world.service.forwarder.counters["shed"] == world.service.dropped()["shed"]
        assert len([line for line in caplog.messages if "has no room" in line]) == 1


class TestFloods:
    """Commands of clients that do not follow the link, all of them late when they come."""

    @pytest.mark.parametrize(
        ("history", "renews"),
        [
            ("late 2", True),
            ("late 1 fresh 0.05 late 1 fresh 0.05 late 1", False),
            ("dated 20", False),  # who sends its clock keeps to the pace of the link
            ("zeros 20", False),
        ],
    )
    def test_make_the_bridge_renew_its_connection(self, start: Start, history: str, *, renews: bool) -> None:
        world = start()
        flood(world, history)
        assert bool(world.uplink.renewed) is renews
        assert not [one for one in world.local.on(DRIVE) if history.startswith("late 2")]

    def test_not_more_often_than_every_half_a_minute(self, start: Start) -> None:
        world = start()
        flood(world, "late 100")
        assert [round(later - before) for before, later in pairwise(world.uplink.renewed)] == [RENEW_S] * 3


def flood(world: World, history: str) -> None:
    """Words and seconds: commands that come late, with the sender's clock or without, zeros, nothing, one in time."""
    words = history.split()
    for word, seconds in zip(words[::2], words[1::2], strict=True):
        world.uplink.late_s = LATE_S[word]
        for _ in range(round(float(seconds) * 20)):
            for payload in COMMANDS[word]:
                world.remote.publish("incoming/drive-values", payload)
            world.run(0.05)
