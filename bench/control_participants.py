"""The variants of the control comparison and their processes: brokers and hubs, two ends for each role, and loads.

A load is a process that standard input switches on and off: ``python -m pebble.bench.control_participants
hog|writer|reader [mqtt|zenoh-shm WHERE]``, a busy loop, or one end of a stream of raw 640x480 pictures at 30 Hz, as in
``pebble bench frames``. Line ``1`` switches it on, ``0`` off, ``?`` does nothing; each is answered with the number of
pictures so far.
"""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from pebble.bench.control_ends import Answer, SliceSpec
from pebble.bench.null import variant_of
from pebble.bench.usage import cpu_s, wake_ups
from pebble.errors import PebbleError
from pebble.rig.broker import Broker
from pebble.rig.processes import BROKERS, Processes, python
from pebble.rig.programs import Program, Worker
from pebble.rig.worker_end import answer, serve_on_thread
from pebble.transports.settings import MqttSettings, ZenohSettings

if TYPE_CHECKING:
    from pebble.bench.frames_worker import Reader, Writer

NONE, MEDIA, HOG = LOADS = ("none", "media", "hog")
_ENDS, _LOADS = "pebble.bench.control_ends", "pebble.bench.control_participants"
_READY_S = 40.0
_ANSWER_S = 30.0  # in addition to the slice itself
_FLOWING = 3  # pictures received until the stream counts as flowing
_FLOW_S = 10.0
_POLL_S = 0.02
PICTURES_HZ = 30.0  # as in bench/frames_worker.py
_PICTURE = 640 * 480 * 3  # bytes
_READ_S = 0.2
_ALIVE_S = 0.01  # of reading while off: the client's network loop must run to stay connected
_EVERY = 64  # bytes: one in each cache line is read
_REST_S = 1.0  # between two runs of the network loop while off


@dataclass(frozen=True, slots=True, kw_only=True)
class Variant:
    """``kind`` is a transport, or ``paho``; ``broker`` holds lines of mosquitto's configuration."""

    about: str
    kind: str
    protocol: str = "3.1.1"
    broker: tuple[str, ...] = ()
    client: bool = False  # Zenoh client mode: everything goes through the hub


_NODELAY = ("set_tcp_nodelay true",)
VARIANTS = {
    "paho": Variant(about="stock paho at both ends, stock mosquitto: TCP_NODELAY nowhere", kind="paho"),
    "mqtt": Variant(about="Pebble's MQTT transport (TCP_NODELAY), stock mosquitto (without)", kind="mqtt"),
    "mqtt-nodelay": Variant(about="the same, with TCP_NODELAY in the broker", kind="mqtt", broker=_NODELAY),
    "mqtt5": Variant(about="MQTT 5, TCP_NODELAY on both sides", kind="mqtt", protocol="5", broker=_NODELAY),
    "zenoh-p2p": Variant(about="Pebble's Zenoh transport, peer to peer", kind="zenoh"),
    "zenoh-hub": Variant(about="the same, through the hub", kind="zenoh", client=True),
}
BASELINE = "mqtt"
P2P, HUB = "zenoh-p2p", "zenoh-hub"
MQTT = tuple(name for name, variant in VARIANTS.items() if variant.kind != "zenoh")

Usage = dict[str, float | None]
"""By name, as in the results: CPU in % of one core, wake-ups per round trip, pictures per second."""


class Participant:
    """The processes of one role: the broker of an MQTT variant or the hub of a Zenoh one, two ends, and a stream."""

    def __init__(self, role: str, folder: Path, processes: Processes) -> None:
        self._role, self._processes = role, processes
        self._variant, self._run_dir = VARIANTS[variant_of(role)], folder / "z"
        self._backbone: Program
        if self._variant.kind == "zenoh":
            command = python("pebble.runtime.hub", _json(ZenohSettings(run_dir=self._run_dir)))
            self._backbone = processes.add(Program("hub", command, folder / "hub.log"), BROKERS)
        else:
            self._backbone = processes.broker(extra=self._variant.broker, folder=folder)
        self._ends: list[Worker] = []  # echo, sender
        self.media: list[Worker] = []  # reader, writer

    def start(self, *, media: bool) -> None:
        """Starts the other processes as soon as the broker or hub is ready."""
        settings: MqttSettings | ZenohSettings
        if isinstance(self._backbone, Broker):
            self._backbone.wait()
            settings = MqttSettings(host="127.0.0.1", port=self._backbone.port, protocol=self._variant.protocol)
            stream = ("mqtt", str(self._backbone.port))
        else:
            self._backbone.wait_until((self._run_dir / "hub.sock").exists, _READY_S)
            settings = ZenohSettings(run_dir=self._run_dir, client=self._variant.client)
            stream = ("zenoh-shm", str(self._run_dir))
        where = (self._variant.kind, _json(settings))
        self._ends = [self._worker(end, _ENDS, *where) for end in ("echo", "sender")]
        if media:
            self.media = [self._worker(end, _LOADS, *stream) for end in ("reader", "writer")]

    def _worker(self, end: str, module: str, *arguments: str) -> Worker:
        return self._processes.worker(f"{self._role}: {end}", module, end, *arguments)

    def run(self, spec: SliceSpec) -> tuple[Answer, Usage]:
        """Runs one slice; returns the sender's answer, and what the two ends and the backbone used meanwhile."""
        used: Usage = {}
        every = {"": [worker.pid for worker in self._ends], "broker_": [self._backbone.pid]}
        began, before = time.monotonic(), {name: (cpu_s(pids), wake_ups(pids)) for name, pids in every.items()}
        answer = msgspec.convert(self._ends[1].ask(_json(spec), spec.seconds + _ANSWER_S), Answer)
        took = time.monotonic() - began
        for name, pids in every.items():
            cpu_before, woken_before = before[name]
            used[f"{name}cpu_percent"] = 100 * (cpu_s(pids) - cpu_before) / took
            used[f"{name}wake_ups"] = (wake_ups(pids) - woken_before) / answer.trips
        return answer, used

    def flowing(self) -> int:
        """Waits until some pictures have arrived; returns their number so far. Raises PebbleError after a timeout."""
        enough, end = self.pictures() + _FLOWING, time.monotonic() + _FLOW_S
        while (count := self.pictures()) < enough:
            if time.monotonic() > end:
                raise PebbleError(f"{self._role}: no pictures flow after {_FLOW_S:.0f} s")
            time.sleep(_POLL_S)
        return count

    def pictures(self) -> int:
        """How many pictures the reader has received so far."""
        return int(self.media[0].ask("?", _FLOW_S)["pictures"])


class Participants(Processes):
    """All participants of some rounds; they are ready when the ``with`` block begins."""

    def __init__(self, roles: Sequence[str], loads: Sequence[str]) -> None:
        super().__init__()
        self._roles, self._loads = roles, loads
        self._participants: dict[str, Participant] = {}
        self._hogs: list[Worker] = []

    def run(self, role: str, spec: SliceSpec, load: str) -> tuple[Answer, Usage]:
        """Runs one slice. Raises PebbleError if a process ended, or pictures do not flow."""
        participant = self._participants[role]
        busy = {NONE: [], MEDIA: participant.media, HOG: self._hogs}[load]
        try:
            for worker in busy:
                worker.ask("1", _FLOW_S)
            if load != MEDIA:
                return participant.run(spec)
            before, began = participant.flowing(), time.monotonic()
            answer, used = participant.run(spec)
            pictures, took = participant.pictures() - before, time.monotonic() - began
            return answer, {**used, "pictures_hz": pictures / took}
        finally:
            for worker in reversed(busy):  # first the writer, then the reader
                worker.ask("0", _FLOW_S)

    def start(self) -> None:
        for number, role in enumerate(self._roles):
            folder = self.folder / str(number)  # short: paths of Unix sockets begin with it
            folder.mkdir()
            self._participants[role] = Participant(role, folder, self)
        for participant in self._participants.values():
            participant.start(media=MEDIA in self._loads)
        if HOG in self._loads:
            self._hogs = [self.worker("hog", _LOADS, "hog")]
        for worker in self.workers:
            worker.answer(_READY_S)


def _json(what: MqttSettings | ZenohSettings | SliceSpec) -> str:
    return msgspec.json.encode(what, enc_hook=str).decode()


# -- a load as a process


class Switch:
    """Switches the load as standard input requests, and answers with the number of pictures."""

    def __init__(self) -> None:
        self.pictures = 0
        self._on = threading.Event()
        self.wait = self._on.wait  # until it is on, or standard input closes
        self._ended = serve_on_thread(self._handle, self._on.set)
        answer({"pictures": 0})  # it is ready

    @property
    def ended(self) -> bool:
        return self._ended.is_set()

    @property
    def on(self) -> bool:
        return self._on.is_set() and not self.ended

    def _handle(self, line: str) -> dict[str, Any]:
        if line == "1":
            self._on.set()
        elif line == "0":
            self._on.clear()
        return {"pictures": self.pictures}


def hog(switch: Switch) -> None:
    while not switch.ended:
        switch.wait()
        while switch.on:
            pass


def write(writer: Writer, switch: Switch) -> None:
    import numpy as np  # only the processes of a stream need it

    picture = np.random.default_rng(1).integers(0, 256, _PICTURE, dtype=np.uint8)
    while not switch.ended:
        switch.wait()
        due = time.monotonic()
        while switch.on:
            switch.pictures += writer.write(lambda frame: np.copyto(frame, picture))
            due += 1 / PICTURES_HZ
            time.sleep(max(0.0, due - time.monotonic()))
    writer.close()


def read(reader: Reader, switch: Switch) -> None:
    while not switch.ended:
        switch.wait(_REST_S)
        frame = reader.read(_READ_S if switch.on else _ALIVE_S)
        if frame is not None:
            switch.pictures += bool(frame[::_EVERY].any())
            del frame
    reader.close()


def main(role: str, kind: str = "", where: str = "") -> None:
    if role == "hog":
        return hog(Switch())
    from pebble.bench import frames_worker

    if role == "writer":
        return write(frames_worker.writer(kind, where, _PICTURE), Switch())
    return read(frames_worker.reader(kind, where), Switch())


if __name__ == "__main__":
    main(*sys.argv[1:])
