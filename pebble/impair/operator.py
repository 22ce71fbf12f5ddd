"""The operator of one robot, on the broker's side of the link: drives all the time, watches, then listens.

As a process: ``python -m pebble.impair.operator HOST PORT BASE``. It says when the robot is up, then does what each
line on its standard input asks for (pebble.impair.messages), and ends with its standard input.
"""

from __future__ import annotations

import queue
import sys
import threading
import time
from collections.abc import Callable

import msgspec

from pebble import codec
from pebble.bench.bridge_operator import wheels
from pebble.contract import DRIVE, ONLINE, STATUS
from pebble.errors import PayloadError, PebbleError
from pebble.impair.messages import Beat, Command, Order, Picture, Record, Said, Settle, Sound, Window
from pebble.media.audience import Audience
from pebble.media.decode import Decoded
from pebble.media.sound import Heard
from pebble.media.viewer import Medium
from pebble.payloads import Drive
from pebble.transports import Message, MqttSettings, QoS, State, Transport, create

_PERIOD_S = 0.1  # between two drive commands
_UP_S, _CONNECT_S, _KNOWN_S = 60.0, 10.0, 5.0
_FIRST_S = 5.0  # the longest wait for a first picture or sound: then the window begins without
_LOOK_S = 0.05
_BEATS_BEFORE = 12  # those that an operator's page judges by when a trial begins
_FRESH_MS, _FRESH_BEATS, _SETTLE_S = 500, 3, 20.0


class Witness(Audience):
    """Remembers when each picture and each sound came."""

    def __init__(self, transport: Transport, base: str) -> None:
        self.saw: list[Picture] = []
        self.heard: list[Sound] = []
        super().__init__(transport, base)

    def came(self, medium: Medium) -> bool:
        return bool(self.saw if medium == "video" else self.heard)

    def on_picture(self, seen: Decoded) -> None:
        now = time.monotonic_ns()
        self.saw.append(Picture(None if seen.captured_ms is None else _monotonic_ns(seen.captured_ms), now))

    def on_sound(self, heard: Heard) -> None:
        now = time.monotonic_ns()
        seconds = len(heard.samples) / heard.rate
        self.heard.append(Sound(_monotonic_ns(heard.captured_ms), now, seconds, heard.sequence))


class Operator:
    """Drives over one connection and watches over another; ``ended`` makes it stop whatever it does."""

    def __init__(self, host: str, port: int, base: str, ended: threading.Event) -> None:
        self._base, self._ended = base, ended
        settings = MqttSettings(host=host, port=port)
        self._controls = create("mqtt", "pebble-impair-controls", settings)
        self._media = create("mqtt", "pebble-impair-media", settings)
        self._number = 0
        self._commands: list[Command] = []
        self._beats: list[Beat] = []
        self._services: dict[str, str] = {}  # their states
        self._over_at = time.monotonic()

    def open(self) -> None:
        """Returns when the robot is up; raises PebbleError if there is no broker, or no robot."""
        links = (self._controls, self._media)
        for link in links:
            link.open(timeout=0.0)
        if not self._wait(lambda: all(link.state is State.CONNECTED for link in links), _CONNECT_S):
            raise PebbleError(f"the operator finds no broker: {links[0].problem or links[1].problem}")
        self._controls.subscribe(ONLINE.topic(self._base), self._hear_beat)
        self._controls.subscribe(STATUS.topic(self._base), self._hear_status)
        if not self._wait(self._up, _UP_S):
            raise PebbleError(f"the robot is not up after {_UP_S:.0f} s: {self._services or 'it says nothing'}")

    def close(self) -> None:
        self._controls.close()
        self._media.close()

    def settle(self, quiet_s: float) -> None:
        """Until the link has nothing old to deliver. Raises PebbleError if the robot does not recover."""
        self._wait(lambda: time.monotonic() - self._over_at >= quiet_s, quiet_s)
        if not self._wait(self._fresh, _SETTLE_S):
            raise PebbleError(f"no fresh heartbeat {_SETTLE_S:.0f} s after the link was made good again")

    def go_through(self, order: Order) -> Record:
        """One trial."""
        first_beat = max(0, len(self._beats) - _BEATS_BEFORE)
        self._commands.clear()
        enough = threading.Event()
        driver = threading.Thread(target=self._drive, args=(enough,), name="driver", daemon=True)
        driver.start()
        try:
            alone = self._look("alone", order.alone_s)
            seen, video = self._watch("video", order.video, order.window_s)
            heard, audio = self._watch("audio", order.audio, order.window_s, enough, order.grace_s)
        finally:
            enough.set()
            driver.join()
        self._over_at = time.monotonic()
        return Record(
            commands=list(self._commands),
            beats=self._beats[first_beat:],
            pictures=seen.saw,
            sounds=heard.heard,
            alone=alone,
            video=video,
            audio=audio,
            payloads=seen.pictures.total,
        )

    # -- phases

    def _watch(
        self,
        medium: Medium,
        encoding: str | None,
        window_s: float,
        over: threading.Event | None = None,
        grace_s: float = 0.0,
    ) -> tuple[Witness, Window]:
        """Ask, wait for the first of it, look for a while; then set ``over``, and stay to hear what comes late."""
        witness = Witness(self._media, self._base)
        try:
            witness.wait_known(_KNOWN_S)
            asked = time.monotonic()
            witness.viewer.ask(medium, encoding)
            came = self._wait(lambda: witness.came(medium), _FIRST_S, witness)
            first_s = time.monotonic() - asked if came else None
            window = self._look(medium, window_s, witness)
            if over is not None:
                over.set()
            self._wait(lambda: False, grace_s, witness)
        finally:
            witness.end()
        return witness, Window(window.began_ns, window.ended_ns, first_s)

    def _look(self, phase: str, seconds: float, witness: Witness | None = None) -> Window:
        say(Said(phase=phase))
        began = time.monotonic_ns()
        self._wait(lambda: False, seconds, witness)
        ended = time.monotonic_ns()
        say(Said(phase=""))
        return Window(began, ended)

    def _wait(self, condition: _Condition, seconds: float, witness: Witness | None = None) -> bool:
        """Until ``condition``, or so long; as who watches, ask for what is missing meanwhile."""
        end = time.monotonic() + seconds
        while not (met := condition()) and (left := end - time.monotonic()) > 0:
            if self._ended.wait(min(left, _LOOK_S)):
                raise _EndedError
            if witness is not None:
                witness.keep_going()
        return met

    def _up(self) -> bool:
        states = set(self._services.values())
        return bool(states) and states <= {"ready", "stopped"} and len(self._beats) > 1

    def _fresh(self) -> bool:
        newest = self._beats[-_FRESH_BEATS:]
        limit_ns, now = _FRESH_MS * 1_000_000, time.monotonic_ns()
        return len(newest) == _FRESH_BEATS and all(
            beat.online and beat.arrived_ns - beat.sent_ns < limit_ns and now - beat.arrived_ns < 2 * limit_ns
            for beat in newest
        )

    # -- the driver's thread

    def _drive(self, enough: threading.Event) -> None:
        topic, due = DRIVE.topic(self._base), time.monotonic()
        while not enough.is_set():
            self._number += 1
            left, right = wheels(self._number)
            payload = codec.encode(DRIVE, Drive(x=(left - right) / 2, z=(left + right) / 2))
            self._commands.append(Command(left, right, time.monotonic_ns()))
            self._controls.publish(topic, payload, qos=QoS.DELIVERED, urgent=True)
            due += _PERIOD_S
            enough.wait(max(0.0, due - time.monotonic()))

    # -- the transports' threads

    def _hear_beat(self, message: Message) -> None:
        now = time.monotonic_ns()
        if message.retain:
            return  # a kept heartbeat tells nothing about now
        try:
            beat = codec.decode(ONLINE, message.payload)
        except PayloadError:
            return
        self._beats.append(Beat(_monotonic_ns(beat.t), now, beat.online is not False))

    def _hear_status(self, message: Message) -> None:
        try:
            services = codec.decode(STATUS, message.payload).value.get("services", {})
        except PayloadError:
            return
        self._services = {name: service.get("state", "") for name, service in services.items()}


_Condition = Callable[[], bool]


class _EndedError(Exception):
    """Whoever started us wants no more."""


def _monotonic_ns(epoch_ms: int) -> int:
    """A moment of the robot's wall clock, which is this machine's, on its monotonic one."""
    return time.monotonic_ns() - (time.time_ns() - epoch_ms * 1_000_000)


def say(said: Said) -> None:
    sys.stdout.buffer.write(msgspec.json.encode(said) + b"\n")
    sys.stdout.buffer.flush()


def main(arguments: list[str]) -> int:
    host, port, base = arguments
    ended = threading.Event()
    lines: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    threading.Thread(target=_read, args=(lines, ended), name="orders", daemon=True).start()
    operator = Operator(host, int(port), base, ended)
    try:
        operator.open()
        say(Said(ready=True))
        while line := lines.get():
            _obey(operator, line)
    except _EndedError:
        return 0
    except PebbleError as error:
        say(Said(problem=str(error)))
        return 1
    finally:
        operator.close()
    return 0


def _obey(operator: Operator, line: bytes) -> None:
    order = msgspec.json.decode(line, type=Order | Settle)
    if isinstance(order, Settle):
        operator.settle(order.quiet_s)
        say(Said(ready=True))
    else:
        say(Said(record=operator.go_through(order)))


def _read(lines: queue.SimpleQueue[bytes], ended: threading.Event) -> None:
    for line in sys.stdin.buffer:
        lines.put(line)
    ended.set()
    lines.put(b"")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
