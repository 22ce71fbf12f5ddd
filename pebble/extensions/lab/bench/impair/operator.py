"""The operator of one robot, on the broker's side of the network: it drives, and receives video, then audio.

As a process: ``python -m pebble.extensions.lab.bench.impair.operator HOST PORT BASE PLAN``, the plan as JSON. It
reports when the robot is ready, then serves each line, ``trial`` or ``recover``, and ends when its standard input
closes.
"""

from __future__ import annotations

import os
import queue
import sys
import threading
import time
from collections.abc import Callable
from contextlib import closing, suppress
from typing import Any

import msgspec

from pebble.contract import ONLINE, STATUS, Channel, codec
from pebble.contract.payloads import Heartbeat as Online
from pebble.errors import PayloadError, PebbleError
from pebble.extensions.lab.bench.bridge_operator import wheels
from pebble.extensions.lab.bench.clients import all_ready, drive_of
from pebble.extensions.lab.bench.impair.metrics import Arrival, Command, Plan, Report, Window, fps, heard
from pebble.extensions.lab.bench.usage import wall_clock_ahead_ns
from pebble.extensions.lab.rig.scripted_operator import ScriptedOperator, paced
from pebble.extensions.lab.rig.worker_end import answer, serve_on_thread
from pebble.extensions.media.decode import Decoded
from pebble.extensions.media.sound import ReceivedSound
from pebble.extensions.operator.client.media_receiver import MediaReceiver
from pebble.extensions.operator.client.media_request.offer import Medium
from pebble.extensions.operator.client.robot_view import RobotView
from pebble.transports import Message, MqttSettings, State, Transport, create

_RATE_HZ = 10.0  # of drive commands
_UP_S, _CONNECT_S, _KNOWN_S = 60.0, 10.0, 5.0
_FIRST_S = 5.0  # the longest wait for a first picture or sound before the window begins
_POLL_S = 0.05
_FRESH_MS, _FRESH_HEARTBEATS, _STARTUP_S = 500, 3, 20.0


class MediaSubscriber(MediaReceiver):
    """A record of the arrivals of pictures (monotonic ns) and of sound packets."""

    def __init__(self, transport: Transport, base: str) -> None:
        self.pictures_ns: list[int] = []
        self.packets: list[Arrival] = []
        super().__init__(transport, base)

    def on_picture(self, _picture: Decoded) -> None:
        self.pictures_ns.append(time.monotonic_ns())

    def on_sound(self, received: ReceivedSound) -> None:
        now, seconds = time.monotonic_ns(), len(received.samples) / received.rate
        self.packets.append(Arrival(monotonic_ns(received.captured_ms), now, seconds, received.sequence))


class TrialOperator:
    """An operator that drives over one connection and receives media over another."""

    def __init__(self, host: str, port: int, base: str, plan: Plan) -> None:
        self._base, self._plan = base, plan
        settings = MqttSettings(host=host, port=port)
        self._controls = create("mqtt", "pebble-impair-controls", settings)
        self._media = create("mqtt", "pebble-impair-media", settings)
        self._driver = ScriptedOperator(RobotView(base), self._publish, by="bench")
        self._number = 0  # of the newest command
        self._commands: list[Command] = []
        self._heartbeats: list[Arrival] = []
        self._ready = False  # all services
        self._over_at = time.monotonic()  # when the last trial ended; before the first, the start

    def open(self) -> Report:
        """Connect and wait until the robot is ready. Raises PebbleError without a broker or a robot."""
        for connection in (self._controls, self._media):
            connection.open(_CONNECT_S)
            if connection.state is not State.CONNECTED:
                raise PebbleError(f"the operator cannot connect to the broker: {connection.problem}")
        self._subscribe(ONLINE, self._on_heartbeat, retained=False)  # a retained heartbeat is not current
        self._subscribe(STATUS, self._on_status)
        if not _wait(lambda: self._ready and len(self._heartbeats) > 1, _UP_S):
            raise PebbleError(f"the robot is not ready after {_UP_S:.0f} s")
        return Report()  # an empty one: it is ready

    def recover(self) -> Report:
        """Wait until no old messages arrive any more. Raises PebbleError if the robot does not recover."""
        _pause(self._over_at + self._plan.quiet_s - time.monotonic())
        if not _wait(self._is_fresh, _STARTUP_S):
            raise PebbleError(f"no fresh heartbeat {_STARTUP_S:.0f} s after the network was restored")
        return Report()  # an empty one: it has recovered

    def run_trial(self) -> Report:
        """Drive, watch and listen as planned; return what was measured."""
        plan = self._plan
        self._commands.clear()
        enough = threading.Event()
        driver = threading.Thread(target=self._drive, args=(enough,), name="driver", daemon=True)
        driver.start()
        _pause(plan.alone_s)
        with self._watch("video", plan.video) as viewer:
            viewed = _pause(plan.window_s, viewer.poll)
        _pause(plan.off_s)
        with self._watch("audio", plan.audio) as listener:
            listened = _pause(plan.window_s, listener.poll)
            enough.set()
            _pause(plan.grace_s, listener.poll)
        driver.join()
        self._over_at = time.monotonic()
        sound, video_fps = heard(listener.packets, listened), fps(viewer.pictures_ns, viewed)
        return Report(commands=self._commands, heard=sound, fps=video_fps)

    # -- phases

    def _watch(self, medium: Medium, encoding: str | None) -> closing[MediaSubscriber]:
        """Request a medium, and wait for its first message."""
        subscriber = MediaSubscriber(self._media, self._base)
        subscriber.wait_for_capabilities(_KNOWN_S)
        subscriber.request(medium, encoding)
        _wait(lambda: bool(subscriber.pictures_ns or subscriber.packets), _FIRST_S, subscriber.poll)
        return closing(subscriber)

    def _is_fresh(self) -> bool:
        """True if the newest heartbeats came in time, and lately: no message of the last trial waits any more."""
        newest = self._heartbeats[-_FRESH_HEARTBEATS:]
        since_ns = time.monotonic_ns() - 2 * _FRESH_MS * 1_000_000
        fresh = [heartbeat for heartbeat in newest if heartbeat.ms < _FRESH_MS and heartbeat.arrived_ns > since_ns]
        return len(fresh) == _FRESH_HEARTBEATS

    # -- the driver's thread

    def _drive(self, enough: threading.Event) -> None:
        for _ in paced(rate_hz=_RATE_HZ, wait=enough.wait):
            self._number += 1
            left, right = wheels(self._number)
            sent_at = self._driver.command(drive_of(left, right))
            self._commands.append(Command(left, right, round(1e9 * sent_at)))

    def _publish(self, message: Message) -> None:
        self._controls.publish(message.topic, message.payload, qos=message.qos, urgent=True)

    # -- the transports' threads

    def _subscribe(self, channel: Channel, receive: Callable[[Any], None], *, retained: bool = True) -> None:
        def on_message(message: Message) -> None:
            if retained or not message.retain:
                with suppress(PayloadError):
                    receive(codec.decode(channel, message.payload))

        self._controls.subscribe(channel.topic(self._base), on_message)

    def _on_heartbeat(self, heartbeat: Online) -> None:
        if heartbeat.online is not False:
            self._heartbeats.append(Arrival(monotonic_ns(heartbeat.t), time.monotonic_ns()))

    def _on_status(self, status: Any) -> None:
        self._ready = all_ready(status.value)


def _wait(condition: Callable[[], bool], seconds: float, meanwhile: Callable[[], None] = lambda: None) -> bool:
    """Wait for ``condition``, at most ``seconds``, calling ``meanwhile`` now and then; return True if it is met."""
    end = time.monotonic() + seconds
    while not (met := condition()) and (remaining_s := end - time.monotonic()) > 0:
        time.sleep(min(remaining_s, _POLL_S))
        meanwhile()
    return met


def _pause(seconds: float, meanwhile: Callable[[], None] = lambda: None) -> Window:
    """Wait for ``seconds``; return that time as a window."""
    began_ns = time.monotonic_ns()
    _wait(lambda: False, seconds, meanwhile)
    return Window(began_ns, time.monotonic_ns())


def monotonic_ns(epoch_ms: int) -> int:
    """Convert a wall-clock time of the robot, which runs on this machine, to the monotonic clock."""
    return epoch_ms * 1_000_000 - wall_clock_ahead_ns()


def main(host: str, port: str, base: str, plan: str) -> None:
    """Run the operator until standard input closes. The arguments are those of the command line."""
    lines: queue.SimpleQueue[str] = queue.SimpleQueue()
    serve_on_thread(lines.put, lambda: os._exit(0))  # also during a trial
    operator = TrialOperator(host, int(port), base, msgspec.json.decode(plan, type=Plan))
    act = operator.open  # its report is the first one, before any line
    while True:
        try:
            report = act()
        except PebbleError as error:
            report = Report(problem=str(error))
        answer(msgspec.json.encode(report))
        act = operator.run_trial if lines.get() == "trial" else operator.recover


if __name__ == "__main__":
    main(*sys.argv[1:])
