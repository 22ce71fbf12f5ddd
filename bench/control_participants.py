"""The variants of the control comparison and their processes: brokers and hubs, two ends for each role, and loads."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec

from pebble.bench.control_ends import Answer, SliceSpec
from pebble.bench.null import variant_of
from pebble.bench.usage import cpu_s, wake_ups
from pebble.errors import PebbleError
from pebble.rig.broker import Broker
from pebble.rig.processes import BROKERS, Processes, python
from pebble.rig.programs import Program, Worker
from pebble.transports.settings import MqttSettings, ZenohSettings

NONE, MEDIA, HOG = LOADS = ("none", "media", "hog")
_READY_S = 40.0
_ANSWER_S = 30.0  # in addition to the slice itself
_FLOWING = 3  # pictures received until the stream counts as flowing
_FLOW_S = 10.0
_POLL_S = 0.02


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


@dataclass(frozen=True, slots=True, kw_only=True)
class Slice:
    """Results of one slice of one role; CPU in % of one core, wake-ups per round trip."""

    answer: Answer
    cpu: float
    backbone_cpu: float
    wake_ups: float
    backbone_wake_ups: float
    pictures_hz: float | None = None


class Participant:
    """The processes of one role: the broker of an MQTT variant or the hub of a Zenoh one, two ends, and a stream."""

    def __init__(self, role: str, folder: Path, processes: Processes) -> None:
        self.role, self._processes = role, processes
        self._variant, self._run_dir = VARIANTS[variant_of(role)], folder / "z"
        self._broker: Broker | None = None
        if self._variant.kind == "zenoh":
            command = python("pebble.runtime.hub", _json(ZenohSettings(run_dir=self._run_dir)))
            self._backbone = processes.add(Program("hub", command, folder / "hub.log"), BROKERS)
        else:
            self._backbone = self._broker = processes.broker(extra=self._variant.broker, folder=folder)
        self.ends: list[Worker] = []  # echo, sender
        self.media: list[Worker] = []  # reader, writer

    def start(self, *, media: bool) -> None:
        """Starts the other processes as soon as the broker or hub is ready."""
        settings: MqttSettings | ZenohSettings
        if self._broker is None:
            self._backbone.wait_until((self._run_dir / "hub.sock").exists, _READY_S)
            settings = ZenohSettings(run_dir=self._run_dir, client=self._variant.client)
            stream = ("zenoh-shm", str(self._run_dir))
        else:
            self._broker.wait()
            settings = MqttSettings(host="127.0.0.1", port=self._broker.port, protocol=self._variant.protocol)
            stream = ("mqtt", str(self._broker.port))
        where = (self._variant.kind, _json(settings))
        self.ends = [self._worker(end, "control_ends", *where) for end in ("echo", "sender")]
        if media:
            self.media = [self._worker(end, "control_load", *stream) for end in ("reader", "writer")]

    def run(self, spec: SliceSpec) -> Slice:
        """Runs one slice; returns the sender's answer and the resource usage of the ends and the backbone."""
        every = ([worker.pid for worker in self.ends], [self._backbone.pid])
        began, before = time.monotonic(), [(cpu_s(pids), wake_ups(pids)) for pids in every]
        answer = msgspec.convert(self.ends[1].ask(_json(spec), spec.seconds + _ANSWER_S), Answer)
        took = time.monotonic() - began
        (cpu, woken), (backbone_cpu, backbone_woken) = (
            (100 * (cpu_s(pids) - cpu_before) / took, (wake_ups(pids) - woken_before) / answer.trips)
            for pids, (cpu_before, woken_before) in zip(every, before, strict=True)
        )
        return Slice(
            answer=answer, cpu=cpu, backbone_cpu=backbone_cpu, wake_ups=woken, backbone_wake_ups=backbone_woken
        )

    def _worker(self, end: str, module: str, *arguments: str) -> Worker:
        return self._processes.worker(f"{self.role}: {end}", f"pebble.bench.{module}", end, *arguments)


class Participants(Processes):
    """All participants of some rounds; they are ready when the ``with`` block begins."""

    def __init__(self, roles: Sequence[str], loads: Sequence[str]) -> None:
        super().__init__()
        self._roles, self._loads = roles, loads
        self._participants: dict[str, Participant] = {}
        self._hogs: list[Worker] = []

    def run(self, role: str, spec: SliceSpec, load: str) -> Slice:
        """Runs one slice. Raises PebbleError if a process ended, or pictures do not flow."""
        participant = self._participants[role]
        busy = {NONE: [], MEDIA: participant.media, HOG: self._hogs}[load]
        try:
            for worker in busy:
                _switch_load(worker, "1")
            if load != MEDIA:
                return participant.run(spec)
            before, began = _flowing(participant), time.monotonic()
            slice_ = participant.run(spec)
            pictures, took = _switch_load(participant.media[0], "?") - before, time.monotonic() - began
            return replace(slice_, pictures_hz=pictures / took)
        finally:
            for worker in reversed(busy):  # first the writer, then the reader
                _switch_load(worker, "0")

    def start(self) -> None:
        for number, role in enumerate(self._roles):
            folder = self.folder / str(number)  # short: paths of Unix sockets begin with it
            folder.mkdir()
            self._participants[role] = Participant(role, folder, self)
        for participant in self._participants.values():
            participant.start(media=MEDIA in self._loads)
        if HOG in self._loads:
            self._hogs = [self.worker("hog", "pebble.bench.control_load", "hog")]
        for worker in self.workers:
            worker.answer(_READY_S)


def _switch_load(worker: Worker, line: str) -> int:
    """Sends a command to a load process; returns its count of pictures so far."""
    return int(worker.ask(line, _FLOW_S)["pictures"])


def _flowing(participant: Participant) -> int:
    """Waits until some pictures have arrived; returns their number so far. Raises PebbleError after a timeout."""
    reader = participant.media[0]
    enough, end = _switch_load(reader, "?") + _FLOWING, time.monotonic() + _FLOW_S
    while (count := _switch_load(reader, "?")) < enough:
        if time.monotonic() > end:
            raise PebbleError(f"{participant.role}: no pictures flow after {_FLOW_S:.0f} s")
        time.sleep(_POLL_S)
    return count


def _json(what: MqttSettings | ZenohSettings | SliceSpec) -> str:
    return msgspec.json.encode(what, enc_hook=str).decode()
