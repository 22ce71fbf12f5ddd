"""The programs beside the robots of ``pebble bench bridge``: ``python -m pebble.bench.bridge_programs WHAT …``.

``frames RUN_DIR`` reads a robot's frames and ``media PORT BASE`` receives its video and sound; both answer every line
with the counts so far. ``hop PORT TOPIC`` is a stock client one hop from the operator: it writes one line once it is
subscribed, and answers every line with the commands since the last one.
"""

from __future__ import annotations

import sys
import time
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from paho.mqtt.client import MQTTMessage

from pebble.bench.bridge_operator import wheels_of
from pebble.contract import AUDIO, CAMERA, DRIVE
from pebble.rig.stock_client import StockClient
from pebble.rig.worker_end import answer, serve, serve_on_thread
from pebble.transports.frames import FrameReader

_READ_S = 0.2
_EVERY = 16  # bytes: one in so many of a picture's is read


def frames(run_dir: str) -> None:
    counts: Counter[str] = Counter()
    ended = serve_on_thread(lambda _line: dict(counts))
    with FrameReader(Path(run_dir), "camera", views=True) as reader:
        while not ended.is_set():
            frame = reader.read(_READ_S)
            if frame is not None:
                counts["frames"] += bool(frame.data[::_EVERY].any())
                frame.release()


def media(port: str, base: str) -> None:
    names = {CAMERA.topic(base): "video", AUDIO.topic(base): "audio"}
    counts: Counter[str] = Counter()

    def count(message: MQTTMessage) -> None:
        counts[names[message.topic]] += 1

    client = StockClient(count, [(topic, 0) for topic in names], at_once=False).open(int(port))
    serve(lambda _line: dict(counts))
    client.close()


def hop(port: str, topic: str) -> None:
    received: list[tuple[int, bytes]] = []

    def receive(message: MQTTMessage) -> None:
        if not message.payload.isspace():  # else a bridge's probe
            received.append((time.monotonic_ns(), bytes(message.payload)))

    def take(_line: str) -> dict[str, Any]:
        new = received.copy()
        del received[: len(new)]
        return {"received": [[*wheels_of(payload), ns] for ns, payload in new]}

    client = StockClient(receive, [(topic, DRIVE.default_qos)], at_once=False).open(int(port))
    client.wait()
    answer({"subscribed": True})
    serve(take)
    client.close()


_PROGRAMS: Mapping[str, Callable[..., None]] = {"frames": frames, "media": media, "hop": hop}

if __name__ == "__main__":
    _PROGRAMS[sys.argv[1]](*sys.argv[2:])
