"""The recorder beside the operator page and four robots: ``python -m tests.recordings.endurance --minutes 60 DIR``.

A reference subscriber receives the same. Afterwards: is each of its messages in the recording, byte for byte and in
order; what did the recorder cost, beside a plain logger that receives the same, and did it grow?
"""

from __future__ import annotations

import argparse
import hashlib
import itertools
import signal
import subprocess
import sys
import time
from collections import defaultdict
from pathlib import Path

from pebble.bench.usage import cpu_s
from pebble.client.viewer import Viewer
from pebble.contract import DRIVE, codec
from pebble.contract.payloads import Drive
from pebble.errors import PebbleError
from pebble.recordings.library import files, merged
from pebble.rig.testbed import ROBOTS
from pebble.transports import Message, MqttSettings, QoS, Transport, create
from tests.own_memory import own_mb
from tests.support import quarters, until
from tests.web.stage import Stage

ENCODINGS = ("json", "pbvd", "h264")
_SAMPLE_S, _DRIVE_S, _CHANGE_S = 20.0, 10.0, 60.0
_PERIOD_S = 0.05  # of drive commands
_DIGEST = 8  # bytes of each payload that are compared


class Reference:
    """A subscriber with QoS 1 that remembers a digest of each live message, by topic and in order."""

    def __init__(self, port: int) -> None:
        self.digests: dict[str, bytearray] = defaultdict(bytearray)
        self.transport = _client(port, "reference")
        self.transport.subscribe("#", self._receive, qos=QoS.DELIVERED, direct=True)

    def _receive(self, message: Message) -> None:
        if not message.retain:
            self.digests[message.topic] += _digest(message.payload)


class Operator:
    """Drives all robots for ten seconds of twenty, and watches those with cameras in one encoding after the other."""

    def __init__(self, port: int, bases: list[str]) -> None:
        self._transport, self._bases = _client(port, "operator"), bases
        self._viewers = [Viewer(self._transport, base, lambda _medium, _payload: None) for base in bases]
        self._encodings = itertools.cycle(ENCODINGS)
        self._changed_at = float("-inf")
        self._began = time.monotonic()

    def step(self) -> None:
        now = time.monotonic()
        if now - self._changed_at >= _CHANGE_S:
            self._changed_at = now
            self._watch(next(self._encodings))
        for viewer in self._viewers:
            viewer.repeat_requests()
        if int((now - self._began) / _DRIVE_S) % 2 == 0:
            for base in self._bases:
                self._transport.publish(DRIVE.topic(base), codec.encode(DRIVE, Drive(x=0.0, z=0.4)), urgent=True)

    def _watch(self, encoding: str) -> None:
        for viewer in self._viewers:
            for medium, wanted in (("video", encoding), ("audio", None)):
                try:
                    viewer.request(medium, wanted)  # type: ignore[arg-type]
                except PebbleError:  # it has none
                    continue

    def close(self) -> None:
        for viewer in self._viewers:
            viewer.close()
        self._transport.close()


def missing(folder: Path, reference: Reference) -> tuple[int, int]:
    """How many messages the reference has, and how many of them are not in the recording at their place."""
    recorded: dict[str, bytearray] = defaultdict(bytearray)
    for message in merged(files([folder])):
        if not message.channel.metadata.get("retained"):
            recorded[message.channel.topic] += _digest(message.payload)
    total = lacking = 0
    for topic, wanted in reference.digests.items():
        total += len(wanted) // _DIGEST
        if bytes(wanted) not in recorded[topic]:
            sys.stdout.write(f"{topic}: not the same ({len(recorded[topic]) // _DIGEST} recorded)\n")
            lacking += len(wanted) // _DIGEST
    return total, lacking


def _digest(payload: bytes) -> bytes:
    return hashlib.blake2b(payload, digest_size=_DIGEST).digest()


def _client(port: int, name: str) -> Transport:
    transport = create("mqtt", name, MqttSettings(host="127.0.0.1", port=port))
    transport.open()
    return transport


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.recordings.endurance", description=__doc__)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("folder", type=Path, help="for the recording; it stays there")
    options = parser.parse_args()
    with Stage() as stage:
        command = [sys.executable, "-m", "pebble.cli", "record", "--url", f"mqtt://127.0.0.1:{stage.broker_port}"]
        recorder = subprocess.Popen([*command, "--into", str(options.folder)])
        assert until((options.folder / "recorder.json").exists, 30), "the recorder did not start"
        time.sleep(2.0)  # it is subscribed by then
        plain = subprocess.Popen([sys.executable, "-m", "tests.recordings.plain_logger", str(stage.broker_port)])
        reference = Reference(stage.broker_port)
        operator = Operator(stage.broker_port, [stage.ref(name) for name in ROBOTS])
        try:
            cpu, plain_cpu, memory = _observe(recorder.pid, plain.pid, operator, 60 * options.minutes)
            operator.close()
            reference.transport.close()
            time.sleep(2.0)
        finally:
            plain.kill()
            plain.wait()
            recorder.send_signal(signal.SIGTERM)
            recorder.wait(20)
    total, lacking = missing(options.folder, reference)
    sys.stdout.write(
        f"{total} messages, {lacking} of topics that differ; {cpu:.2f} % of a core, "
        f"{cpu / plain_cpu:.2f} of the plain logger's {plain_cpu:.2f}; MB, medians of the quarters: "
        f"{' '.join(f'{value:.1f}' for value in quarters(memory))}, highest {max(memory):.1f}\n"
    )
    return 1 if lacking else 0


def _observe(recorder: int, plain: int, operator: Operator, seconds: float) -> tuple[float, float, list[float]]:
    """The share of a processor of both, percent, and what the recorder has allocated now and then, MB."""
    began, memory, due = time.monotonic(), list[float](), 0.0
    before = {pid: cpu_s([pid]) for pid in (recorder, plain)}

    def share(pid: int) -> float:
        return 100 * (cpu_s([pid]) - before[pid]) / max(1.0, time.monotonic() - began)

    while (passed := time.monotonic() - began) < seconds:
        operator.step()
        if passed >= due:
            memory.append(own_mb(recorder))
            due += _SAMPLE_S
            sys.stdout.write(
                f"{passed / 60:5.1f} min: {share(recorder):.2f} % of a core, {memory[-1]:.1f} MB; "
                f"plain logger {share(plain):.2f} %\n"
            )
            sys.stdout.flush()
        time.sleep(_PERIOD_S)
    return share(recorder), share(plain), memory


if __name__ == "__main__":
    sys.exit(main())
