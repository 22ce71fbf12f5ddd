"""The operator of one robot, on the broker's side of the network: drives, receives video, then audio, and plays a clip.

As a process: ``python -m pebble.bench.impair.operator HOST PORT BASE``. It reports when the robot is ready, then serves
each request (pebble.bench.impair.metrics), and ends when its standard input closes.
"""

from __future__ import annotations

import queue
import sys
import threading
import time
from collections.abc import Callable
from contextlib import closing, suppress
from typing import Any

import msgspec

from pebble.bench.bridge_operator import wheels
from pebble.bench.impair import metrics
from pebble.bench.impair.metrics import OperatorReport, Record, RecoveryRequest, TrialRequest, Window
from pebble.client.media_receiver import MediaReceiver
from pebble.client.viewer import Medium
from pebble.contract import DRIVE, ONLINE, SOUNDBOARD_COMMAND, SOUNDBOARD_STATUS, STATUS, Channel, codec
from pebble.contract.payloads import Drive, Heartbeat, SoundboardCommand, SoundboardStatus, Status
from pebble.errors import PayloadError, PebbleError
from pebble.media.decode import Decoded
from pebble.media.sound import ReceivedSound
from pebble.rig.worker_end import answer, serve_on_thread
from pebble.transports import Message, MqttSettings, QoS, State, Transport, create

CLIP = "clip.wav"  # in the folder of the robot's soundboard
_PERIOD_S = 0.1  # between two drive commands
_UP_S, _CONNECT_S, _KNOWN_S = 60.0, 10.0, 5.0
_FIRST_S = 5.0  # the longest wait for a first picture or sound before the window begins
_POLL_S = 0.05
_HEARTBEATS_BEFORE = 12  # heartbeats by which an operator's page judges when a trial begins
_FRESH_MS, _FRESH_HEARTBEATS, _STARTUP_S = 500, 3, 20.0


class MediaSubscriber(MediaReceiver):
    """Records when each picture and each sound packet arrived."""

    def __init__(self, transport: Transport, base: str) -> None:
        self.pictures_seen: list[metrics.Picture] = []
        self.received: list[metrics.Sound] = []
        super().__init__(transport, base)

    def on_picture(self, picture: Decoded) -> None:
        now, ms = time.monotonic_ns(), picture.captured_ms
        self.pictures_seen.append(metrics.Picture(None if ms is None else _monotonic_ns(ms), now))

    def on_sound(self, received: ReceivedSound) -> None:
        now, seconds = time.monotonic_ns(), len(received.samples) / received.rate
        self.received.append(metrics.Sound(_monotonic_ns(received.captured_ms), now, seconds, received.sequence))


class TrialOperator:
    """Drives over one connection and receives media over another; SystemExit interrupts it when ``ended`` is set."""

    def __init__(self, host: str, port: int, base: str, ended: threading.Event) -> None:
        self._base, self._ended = base, ended
        settings = MqttSettings(host=host, port=port)
        self._controls = create("mqtt", "pebble-impair-controls", settings)
        self._media = create("mqtt", "pebble-impair-media", settings)
        self._number = 0
        self._commands: list[metrics.Command] = []
        self._heartbeats: list[metrics.Heartbeat] = []
        self._services: dict[str, str] = {}  # their states
        self._clip_statuses: list[tuple[int, bool]] = []  # when they arrived, and whether a clip plays
        self._over_at = time.monotonic()

    def open(self) -> None:
        """Connects and waits until the robot is ready. Raises PebbleError without a broker or a robot."""
        connections = (self._controls, self._media)
        for connection in connections:
            connection.open(timeout=0.0)
        if not self._wait(lambda: all(connection.state is State.CONNECTED for connection in connections), _CONNECT_S):
            problem = self._controls.problem or self._media.problem
            raise PebbleError(f"the operator cannot connect to the broker: {problem}")
        self._subscribe(ONLINE, self._on_heartbeat, retained=False)  # a retained heartbeat is not current
        self._subscribe(STATUS, self._on_status)
        self._subscribe(SOUNDBOARD_STATUS, self._on_clip_status)
        if not self._wait(self._is_ready, _UP_S):
            raise PebbleError(f"the robot is not ready after {_UP_S:.0f} s: {self._services or 'no status received'}")

    def close(self) -> None:
        self._controls.close()
        self._media.close()

    def serve(self, request: TrialRequest | RecoveryRequest) -> OperatorReport:
        """Runs a trial, or waits until the network delivers no old messages.

        Raises PebbleError if the robot does not recover.
        """
        if isinstance(request, TrialRequest):
            return OperatorReport(record=self._run_trial(request))
        self._wait(lambda: time.monotonic() - self._over_at >= request.quiet_s, request.quiet_s)
        if not self._wait(self._is_fresh, _STARTUP_S):
            raise PebbleError(f"no fresh heartbeat {_STARTUP_S:.0f} s after the network was restored")
        return OperatorReport(ready=True)

    def _run_trial(self, request: TrialRequest) -> Record:
        first_heartbeat = max(0, len(self._heartbeats) - _HEARTBEATS_BEFORE)
        self._commands.clear()
        enough = threading.Event()
        driver = threading.Thread(target=self._drive, args=(enough,), name="driver", daemon=True)
        driver.start()
        try:
            alone = self._measure_phase("alone", request.alone_s)
            seen, video = self._watch("video", request, enough)
            video_off = self._measure_phase("video off", request.off_s)
            received, audio = self._watch("audio", request, enough)
        finally:
            enough.set()
            driver.join()
        audio_off = self._measure_phase("audio off", request.off_s)
        clip = self._play_clip(request.clip_s)
        self._over_at = time.monotonic()
        return Record(
            commands=list(self._commands), heartbeats=self._heartbeats[first_heartbeat:],
            pictures=seen.pictures_seen, payloads=seen.pictures.count, sounds=received.received,
            alone=alone, video=video, audio=audio, video_off=video_off, audio_off=audio_off, clip=clip,
        )  # fmt: skip

    # -- phases

    def _watch(self, medium: Medium, request: TrialRequest, enough: threading.Event) -> tuple[MediaSubscriber, Window]:
        """Requests a medium, waits for its first message, records a window. Audio, which is last, ends the driving."""
        with closing(MediaSubscriber(self._media, self._base)) as subscriber:
            subscriber.wait_for_capabilities(_KNOWN_S)
            arrived = subscriber.pictures_seen if medium == "video" else subscriber.received
            asked = time.monotonic()
            subscriber.viewer.request(medium, request.video if medium == "video" else request.audio)
            started = self._wait(lambda: bool(arrived), _FIRST_S, subscriber)
            first_s = time.monotonic() - asked if started else None
            window = self._measure_phase(medium, request.window_s, subscriber)
            if medium == "audio":
                enough.set()
                self._wait(lambda: False, request.grace_s, subscriber)
        return subscriber, Window(window.began_ns, window.ended_ns, first_s)

    def _play_clip(self, seconds: float) -> metrics.ClipCommand:
        """Commands it, and waits until it was played to its end, as far as the statuses arrive."""
        self._clip_statuses.clear()
        sent_ns = time.monotonic_ns()
        payload = codec.encode(SOUNDBOARD_COMMAND, SoundboardCommand(action="play", file=CLIP))
        self._controls.publish(SOUNDBOARD_COMMAND.topic(self._base), payload, qos=QoS.DELIVERED)

        def playing_ns() -> int | None:
            return next((ns for ns, playing in list(self._clip_statuses) if playing), None)

        self._wait(lambda: playing_ns() is not None and not self._clip_statuses[-1][1], seconds)
        return metrics.ClipCommand(sent_ns, playing_ns())

    def _measure_phase(self, phase: str, seconds: float, subscriber: MediaSubscriber | None = None) -> Window:
        write_report(OperatorReport(phase=phase))
        began = time.monotonic_ns()
        self._wait(lambda: False, seconds, subscriber)
        ended = time.monotonic_ns()
        write_report(OperatorReport(phase=""))
        return Window(began, ended)

    def _wait(self, condition: Callable[[], bool], seconds: float, subscriber: MediaSubscriber | None = None) -> bool:
        """Waits for ``condition``; with a subscriber, keeps requesting its media meanwhile."""
        end = time.monotonic() + seconds
        while not (met := condition()) and (left := end - time.monotonic()) > 0:
            if self._ended.wait(min(left, _POLL_S)):
                sys.exit()
            if subscriber is not None:
                subscriber.poll()
        return met

    def _is_ready(self) -> bool:
        states = set(self._services.values())
        return bool(states) and states <= {"ready", "stopped"} and len(self._heartbeats) > 1

    def _is_fresh(self) -> bool:
        newest = self._heartbeats[-_FRESH_HEARTBEATS:]
        since_ns = time.monotonic_ns() - 2_000_000 * _FRESH_MS
        return len(newest) == _FRESH_HEARTBEATS and all(
            heartbeat.online and heartbeat.ms < _FRESH_MS and heartbeat.arrived_ns > since_ns for heartbeat in newest
        )

    # -- the driver's thread

    def _drive(self, enough: threading.Event) -> None:
        topic, due = DRIVE.topic(self._base), time.monotonic()
        while not enough.is_set():
            self._number += 1
            left, right = wheels(self._number)
            payload = codec.encode(DRIVE, Drive(x=(left - right) / 2, z=(left + right) / 2))
            self._commands.append(metrics.Command(left, right, time.monotonic_ns()))
            self._controls.publish(topic, payload, qos=QoS.DELIVERED, urgent=True)
            due += _PERIOD_S
            enough.wait(max(0.0, due - time.monotonic()))

    # -- the transports' threads

    def _subscribe(self, channel: Channel, receive: Callable[[int, Any], None], *, retained: bool = True) -> None:
        """``receive`` is called with the time of arrival and the payload; a malformed one is ignored."""

        def on_message(message: Message) -> None:
            if retained or not message.retain:
                with suppress(PayloadError):
                    receive(time.monotonic_ns(), codec.decode(channel, message.payload))

        self._controls.subscribe(channel.topic(self._base), on_message)

    def _on_heartbeat(self, now: int, payload: Heartbeat) -> None:
        self._heartbeats.append(metrics.Heartbeat(_monotonic_ns(payload.t), now, payload.online is not False))

    def _on_clip_status(self, now: int, payload: SoundboardStatus) -> None:
        self._clip_statuses.append((now, payload.playing))

    def _on_status(self, _now: int, payload: Status) -> None:
        services = payload.value.get("services", {})
        self._services = {name: service.get("state", "") for name, service in services.items()}


def _monotonic_ns(epoch_ms: int) -> int:
    """Converts a wall-clock time of the robot, which runs on this machine, to the monotonic clock."""
    return time.monotonic_ns() - (time.time_ns() - epoch_ms * 1_000_000)


def write_report(report: OperatorReport) -> None:
    answer(msgspec.json.encode(report))


def main(host: str, port: str, base: str) -> int:
    lines: queue.SimpleQueue[str] = queue.SimpleQueue()
    ended = serve_on_thread(lines.put, lambda: lines.put(""))
    try:
        with closing(TrialOperator(host, int(port), base, ended)) as operator:
            operator.open()
            write_report(OperatorReport(ready=True))
            while line := lines.get():
                write_report(operator.serve(msgspec.json.decode(line, type=TrialRequest | RecoveryRequest)))
    except PebbleError as error:
        write_report(OperatorReport(problem=str(error)))
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
