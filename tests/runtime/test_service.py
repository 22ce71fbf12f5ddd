"""The runtime of a service, on the memory transport."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from pebble.config import parse
from pebble.contract import (
    CHARGING_STATUS,
    DRIVE,
    MEDIA_REPORT,
    MQTT_VIDEO,
    REBOOT,
    SOUNDBOARD_COMMAND,
    TOUCH_SENSORS,
    Channel,
    Kind,
)
from pebble.contract.payloads import (
    ChargingStatus,
    Drive,
    MediaReport,
    SoundboardCommand,
    TouchSensors,
    TouchValues,
)
from pebble.service import Service, every, on
from pebble.transports import Message, QoS, State, Subscription, clock
from pebble.transports.memory import MemoryHub, MemoryTransport
from tests.support import WAIT_S, until

BASE = "pebble/robots/rover"
SOUND = f"{BASE}/incoming/soundboard-command"
DRIVE_TOPIC, REBOOT_TOPIC = f"{BASE}/incoming/drive-values", f"{BASE}/incoming/flags/reboot"
CHARGING_TOPIC = f"{BASE}/outgoing/charging-status"


class Recorder(Service):
    """Notes everything that happens to it, and can be made to wait inside a handler."""

    name = "recorder"

    def __init__(self, *arguments: Any, **more: Any) -> None:
        super().__init__(*arguments, **more)
        self.seen: list[Any] = []
        self.life: list[str] = []
        self.threads: set[int] = set()
        self.ticks = 0
        self.go_on = threading.Event()
        self.go_on.set()

    def start(self) -> None:
        self.life.append(f"start {self.transport.state.value}")

    def stop(self) -> None:
        self.life.append(f"stop {self.transport.state.value}")

    @on(DRIVE)
    def drive(self, drive: Drive) -> None:
        self.note(drive.x)

    @on(SOUNDBOARD_COMMAND)
    def sound(self, command: SoundboardCommand) -> None:
        self.note(command.file)

    @on(MQTT_VIDEO)
    def flag(self, value: bool) -> None:
        self.note(value)

    @on(REBOOT)
    def reboot(self, value: bool) -> None:
        self.note(f"reboot {value}")

    @on(MEDIA_REPORT)
    def report(self, report: MediaReport, program: str) -> None:
        self.note((program, report.running))

    @every(seconds=0.01)
    def tick(self) -> None:
        self.ticks += 1
        self.threads.add(threading.get_ident())

    def note(self, value: Any) -> None:
        self.seen.append(value)
        self.threads.add(threading.get_ident())
        self.go_on.wait(WAIT_S)


class Robot:
    """One service on a thread, and an operator's transport beside it."""

    def __init__(self, service_class: type[Recorder] = Recorder, **services: Any) -> None:
        self.hub = MemoryHub()
        config = parse({"robot": {"id": "rover"}, "services": services}, folder=Path("/"), env={})
        self.ahead_s = 0.0  # of the service's clock before the machine's
        self.service = service_class(
            config, MemoryTransport("service", self.hub), clock=lambda: time.monotonic() + self.ahead_s
        )
        self.operator = MemoryTransport("operator", self.hub)
        self.received: list[Message] = []
        self.error: BaseException | None = None
        self._ready = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def _run(self) -> None:
        try:
            self.service.run(ready=self._ready.set)
        except RuntimeError as error:
            self.error = error

    def start(self) -> None:
        self.operator.open()
        self.operator.subscribe(f"{BASE}/outgoing/#", self.received.append)
        self._thread.start()
        assert self._ready.wait(WAIT_S)
        assert until(lambda: self.service.transport.state is State.CONNECTED)

    def publish(self, topic: str, payload: str, *, retain: bool = False) -> None:
        assert self.operator.publish(topic, payload.encode(), qos=QoS.DELIVERED, retain=retain)

    def keep_busy(self, topic: str, payload: str, seen: Any) -> None:
        """Have the service wait inside the handler of this message, until it may go on."""
        self.service.go_on.clear()
        self.publish(topic, payload)
        assert self.saw(seen)

    def saw(self, *expected: Any) -> bool:
        return until(lambda: self.service.seen == list(expected))

    def on_service_thread(self, job: Any) -> None:
        """Run ``job`` as a handler would, and wait for it."""
        done = threading.Event()

        def run() -> None:
            job()
            done.set()

        self.service.post(run)
        assert done.wait(10)

    def received_on(self, topic: str) -> list[Message]:
        return [message for message in self.received if message.topic == topic]

    def end(self) -> None:
        self.service.go_on.set()
        self.service.quit()
        if self._thread.ident is not None:
            self._thread.join(WAIT_S)
            assert not self._thread.is_alive()

    def close(self) -> None:
        self.end()
        self.operator.close()


@pytest.fixture
def robot() -> Iterator[Robot]:
    made = Robot()
    yield made
    made.close()


@pytest.fixture
def running(robot: Robot) -> Robot:
    robot.start()
    return robot


def test_a_message_that_a_handler_fails_on_is_counted_and_ends_nothing(caplog: pytest.LogCaptureFixture) -> None:
    class Fragile(Recorder):
        def note(self, value: Any) -> None:
            if value == 1.0:
                raise RuntimeError("handler failed")
            super().note(value)

    robot = Robot(Fragile)
    robot.start()
    for failures in range(1, 4):
        robot.publish(DRIVE_TOPIC, '{"x": 1}')
        assert until(lambda failures=failures: robot.service.counters["handler_errors"] == failures)  # type: ignore[misc]
    robot.publish(DRIVE_TOPIC, '{"x": 0.5}')
    assert robot.saw(0.5)
    (record,) = [record for record in caplog.records if "drive-values" in record.message]
    assert (record.message, record.levelname) == ("failed on a message on drive-values (1 so far)", "ERROR")
    robot.close()
    assert robot.error is None


@pytest.mark.parametrize("timer", ["every", "call_at", "post"])
def test_a_timer_or_a_reader_that_fails_ends_the_service_safely(timer: str) -> None:
    def fail() -> None:
        raise RuntimeError("it failed")

    robot = Robot()
    robot.start()
    begin: dict[str, Callable[[], object]] = {
        "every": lambda: robot.service.timers.add(0.0, fail, period=0.01),
        "call_at": lambda: robot.service.call_at(0.0, fail),
        "post": fail,
    }
    robot.service.post(lambda: begin[timer]() and None)
    assert until(lambda: robot.error is not None)
    assert robot.service.life[-1] == "stop connected"
    assert robot.service.transport.state is State.CLOSED
    robot.close()


def test_a_service_that_cannot_start_is_stopped_and_one_that_quits_before_it_runs_ends_at_once() -> None:
    class Broken(Recorder):
        def start(self) -> None:
            raise RuntimeError("no such device")

    robot, quits = Robot(Broken), Robot()
    with pytest.raises(RuntimeError, match="no such device"):
        robot.service.run()
    assert robot.service.life == ["stop closed"]
    quits.service.quit()
    quits.service.run()
    assert [entry.split()[0] for entry in quits.service.life] == ["start", "stop"]


def test_hardware_opens_before_the_transport_and_is_closed_before_it_in_reverse_order_even_if_one_fails() -> None:
    class Opener(Recorder):
        def start(self) -> None:
            super().start()
            self.on_stop(lambda: self.life.append("close first"))
            self.on_stop(self.fail)
            self.on_stop(lambda: self.life.append(f"close last {self.transport.state.value}"))

        def fail(self) -> None:
            raise RuntimeError("will not close")

    robot = Robot(Opener)
    robot.start()
    robot.end()
    assert robot.service.life == ["start closed", "stop connected", "close last connected", "close first"]
    assert str(robot.error) == "will not close"
    assert robot.service.transport.state is State.CLOSED


def test_waiting_jobs_are_not_executed_when_the_service_quits(running: Robot) -> None:
    running.keep_busy(DRIVE_TOPIC, '{"x": 0.5}', 0.5)
    running.publish(REBOOT_TOPIC, "true")
    assert until(lambda: running.service.transport.counters["delivered"] == 2)
    running.end()
    assert running.service.seen == [0.5]


def test_timers_go_on_under_a_flood_and_calls_come_when_they_are_due_all_on_one_thread(running: Robot) -> None:
    called: list[float] = []
    due = time.monotonic() + 0.05
    running.on_service_thread(lambda: running.service.call_at(due, lambda: called.append(time.monotonic())))
    before = running.service.ticks
    assert until(lambda: running.publish(DRIVE_TOPIC, '{"x": 0.1}') or (called and running.service.ticks > before))
    assert called[0] >= due
    assert len(running.service.threads) == 1
    assert threading.get_ident() not in running.service.threads


# -- work on the thread that brings it


class Idle(Recorder):
    """Without timers of its own: nothing wakes it."""

    tick = None  # type: ignore[assignment]


@pytest.fixture
def idle() -> Iterator[Robot]:
    made = Robot(Idle, defaults={"retained_publish_interval_seconds": 10_000})
    made.start()
    worked = threading.Event()
    made.service.post(worked.set)
    assert worked.wait(WAIT_S)
    assert run_when_idle(made.service, lambda: None)  # its turn has ended: it sleeps
    yield made
    made.close()


def run_when_idle(service: Service, job: Callable[[], None]) -> bool:
    return until(lambda: service.run_if_idle(job))


def test_a_service_that_works_or_hangs_takes_no_work_of_other_threads(idle: Robot) -> None:
    ran: list[str] = []
    idle.keep_busy(DRIVE_TOPIC, '{"x": 0.5}', 0.5)
    assert not idle.service.run_if_idle(lambda: ran.append("visitor"))
    idle.service.go_on.set()
    assert run_when_idle(idle.service, lambda: ran.append("visitor"))
    assert ran == ["visitor"]


def test_a_timer_that_another_thread_sets_wakes_the_services_own(idle: Robot) -> None:
    called: list[int] = []
    due = time.monotonic() + 0.05
    assert run_when_idle(
        idle.service, lambda: idle.service.call_at(due, lambda: called.append(threading.get_ident())) and None
    )
    assert until(lambda: bool(called))
    assert called[0] != threading.get_ident()


def test_work_of_another_thread_that_fails_ends_the_service_and_not_that_thread(idle: Robot) -> None:
    def fail() -> None:
        raise RuntimeError("it failed")

    assert run_when_idle(idle.service, fail)
    assert until(lambda: str(idle.error) == "it failed")
    assert idle.service.transport.state is State.CLOSED
    assert not idle.service.run_if_idle(lambda: None), "it has ended"


def test_of_several_waiting_drive_commands_only_the_newest_is_handled(running: Robot) -> None:
    running.keep_busy(DRIVE_TOPIC, '{"x": 0.01}', 0.01)
    for number in range(1, 100):
        running.publish(DRIVE_TOPIC, f'{{"x": {number / 100}}}')
    running.publish(REBOOT_TOPIC, "true")
    assert until(lambda: running.service.transport.counters["delivered"] == 101)
    running.service.go_on.set()
    assert running.saw(0.01, 0.99, "reboot True")


@pytest.mark.parametrize("suspended", [False, True])
def test_a_steering_command_that_waited_too_long_is_dropped(
    running: Robot, monkeypatch: pytest.MonkeyPatch, suspended: bool
) -> None:
    """Also while the machine was suspended, in the inbox or before; the service's own clock may have stood still."""
    now = clock.since_boot
    running.keep_busy(SOUND, '{"action": "play", "file": "a"}', "a")
    running.publish(DRIVE_TOPIC, '{"x": 0.5}')
    running.publish(SOUND, '{"action": "play", "file": "b"}')
    assert until(lambda: running.service.transport.counters["delivered"] == 3)
    running.ahead_s = 0.0 if suspended else 0.6
    monkeypatch.setattr(clock, "since_boot", lambda: now() + 0.6 * suspended)
    running.service.go_on.set()
    assert running.saw("a", "b")
    running.publish(DRIVE_TOPIC, '{"x": 0.25}')
    assert running.saw("a", "b", 0.25)
    assert running.service.counters["late"] == 1


def test_a_flood_of_commands_that_wait_does_not_push_out_the_one_that_ends_something(running: Robot) -> None:
    running.keep_busy(SOUND, '{"action": "play", "file": "a"}', "a")
    running.publish(SOUND, '{"action": "Stop", "file": "the end"}')
    for number in range(1500):
        running.publish(SOUND, f'{{"action": "nonsense", "file": "{number}"}}')
    assert until(lambda: running.service.transport.counters["delivered"] == 1502)
    running.service.go_on.set()
    assert until(lambda: running.service.seen[-1] == "1499")
    assert running.service.seen[1:3] == ["the end", "501"]


@pytest.mark.parametrize(
    ("topic", "payload"),
    [(DRIVE_TOPIC, '{"x": 1}'), (REBOOT_TOPIC, "true"), (SOUND, '{"action": "play", "file": "a"}')],
)
def test_retained_commands_are_refused_and_live_ones_and_switches_are_not(
    robot: Robot, topic: str, payload: str
) -> None:
    robot.operator.open()
    robot.publish(topic, payload, retain=True)
    robot.publish(f"{BASE}/incoming/flags/mqtt-video", '{"value": true}', retain=True)
    robot.operator.close()
    robot.start()
    assert until(lambda: robot.service.counters["stale"] == 1)
    assert robot.saw(True), "the last position of a switch"
    robot.publish(topic, payload)
    assert until(lambda: len(robot.service.seen) == 2)


def test_a_malformed_message_is_counted_logged_once_and_replaces_nothing(
    running: Robot, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.WARNING)
    running.keep_busy(DRIVE_TOPIC, '{"x": 0.5}', 0.5)
    running.publish(DRIVE_TOPIC, '{"x": 0}')  # a stop, which must not be lost to what follows
    for _ in range(100):
        running.publish(DRIVE_TOPIC, '{"x": NaN}')
    assert until(lambda: running.service.counters["refused"] == 100)
    running.service.go_on.set()
    assert running.saw(0.5, 0.0)
    assert sum("refused a message" in record.message for record in caplog.records) == 1
    running.publish(REBOOT_TOPIC, " \t\n" * 8)  # by such payloads bridges look for cycles
    assert until(lambda: running.service.counters["blank"] == 1)
    assert running.service.counters["refused"] == 100


def test_the_handler_of_a_pattern_receives_the_names_in_the_topic(running: Robot) -> None:
    running.publish(f"{BASE}/outgoing/media-report/", '{"running": true}', retain=True)
    running.publish(MEDIA_REPORT.topic(BASE, program="camera_publisher"), '{"running": true}')
    running.publish(MEDIA_REPORT.topic(BASE, program="audio_receiver"), '{"running": false}')
    assert running.saw(("camera_publisher", True), ("audio_receiver", False))
    assert (running.service.counters["refused"], running.service.counters["handler_errors"]) == (1, 0)


LAMP = Channel(metric="lab/lamp", kind=Kind.COMMAND, payload=dict[str, Any], doc="Made while running.")
GLOW = Channel(metric="lab/lamp", kind=Kind.STATE, payload=dict[str, Any], doc="Made while running.")


def test_a_channel_made_while_running_is_received_until_its_subscription_is_closed(running: Robot) -> None:
    subscriptions: list[Subscription] = []
    running.on_service_thread(lambda: subscriptions.append(running.service.listen(LAMP, running.service.note)))
    assert until(lambda: subscriptions)
    running.publish(f"{BASE}/incoming/lab/lamp", '{"value": {"on": true}}')
    assert running.saw({"on": True})
    subscriptions[0].close()
    running.publish(f"{BASE}/incoming/lab/lamp", '{"on": false}')
    running.publish(DRIVE_TOPIC, '{"x": 0.5}')
    assert running.saw({"on": True}, 0.5)


def test_state_is_published_again_after_a_reconnect_and_streams_and_what_was_retracted_are_not(running: Robot) -> None:
    touch, topic = TouchSensors(value=TouchValues(a0=1, a1=2, a2=3)), f"{BASE}/outgoing/lab/lamp"
    for publication in ((GLOW, {"on": True}), (TOUCH_SENSORS, touch), (CHARGING_STATUS, ChargingStatus(value=False))):
        running.on_service_thread(lambda publication=publication: running.service.publish(*publication))  # type: ignore[misc]
    assert until(lambda: running.received_on(topic) and running.received_on(CHARGING_TOPIC))
    assert running.hub.retained[topic].payload == b'{"on":true}'
    assert {(one.topic, one.qos, one.retain_requested) for one in running.received if one.topic != topic} == {
        (CHARGING_TOPIC, QoS.DELIVERED, True),
        (f"{BASE}/outgoing/touch-sensors", QoS.DELIVERED, False),
    }
    for _ in range(2):
        running.on_service_thread(lambda: running.service.retract(GLOW))
    assert until(lambda: running.received_on(topic)[-1].payload == b"")
    assert topic not in running.hub.retained
    running.hub.stop(forget=True)
    assert until(lambda: running.service.transport.state is State.CONNECTING)
    running.on_service_thread(lambda: running.service.publish(CHARGING_STATUS, ChargingStatus(value=True)))
    running.received.clear()
    running.hub.start()
    assert until(lambda: running.received_on(CHARGING_TOPIC))
    assert {message.payload for message in running.received} == {b'{"value":true}'}, "the current state, and no more"


def test_a_service_lives_without_a_broker() -> None:
    robot = Robot(defaults={"retained_publish_interval_seconds": 0.02})
    robot.hub.stop()
    robot.operator.open(timeout=0)
    thread = threading.Thread(target=robot.service.run)
    thread.start()
    assert until(lambda: robot.service.ticks > 3)
    robot.service.post(lambda: robot.service.publish(CHARGING_STATUS, ChargingStatus(value=True)) and None)
    robot.operator.subscribe(f"{BASE}/outgoing/#", robot.received.append)
    robot.hub.start()
    assert until(lambda: len(robot.received_on(CHARGING_TOPIC)) > 3), "again and again"
    robot.service.quit()
    thread.join(WAIT_S)
    assert not thread.is_alive()
    robot.operator.close()
