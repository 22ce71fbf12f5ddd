"""The media load on a driven robot: a program on it reads every frame, and an operator receives audio and video.

As a process: ``python -m pebble.bench.bridge_load frames RUN_DIR`` or ``media PORT BASE``. It answers every line on its
standard input with the counts so far, and ends when its standard input closes.
"""

from __future__ import annotations

import json
import sys
import threading
from collections import Counter
from pathlib import Path
from typing import Any

from paho.mqtt.client import Client
from paho.mqtt.enums import CallbackAPIVersion

from pebble.contract import AUDIO, CAMERA
from pebble.transports.frames import FrameReader

_POLL_S = 0.2
_EVERY = 16  # bytes: one in so many of a picture's is read


def main(arguments: list[str]) -> int:
    what, *where = arguments
    counts: Counter[str] = Counter()
    ended = threading.Event()
    threading.Thread(target=_answer, args=(counts, ended), name="answers", daemon=True).start()
    if what == "frames":
        _read_frames(Path(where[0]), counts, ended)
    else:
        _watch(int(where[0]), where[1], counts, ended)
    return 0


def _answer(counts: Counter[str], ended: threading.Event) -> None:
    for _ in sys.stdin:
        sys.stdout.write(json.dumps(dict(counts)) + "\n")
        sys.stdout.flush()
    ended.set()


def _read_frames(run_dir: Path, counts: Counter[str], ended: threading.Event) -> None:
    with FrameReader(run_dir, "camera", views=True) as reader:
        while not ended.is_set():
            frame = reader.read(_POLL_S)
            if frame is not None:
                counts["frames"] += bool(frame.data[::_EVERY].any())
                frame.release()


def _watch(port: int, base: str, counts: Counter[str], ended: threading.Event) -> None:
    names = {CAMERA.topic(base): "video", AUDIO.topic(base): "audio"}

    def count(_client: Client, _data: Any, message: Any) -> None:
        name = names[message.topic]
        counts[name] += 1
        counts[f"{name}_bytes"] += len(message.payload)

    client = Client(CallbackAPIVersion.VERSION2)
    client.on_message = count
    client.on_connect = lambda connected, *_: connected.subscribe([(topic, 0) for topic in names])
    client.connect("127.0.0.1", port)
    while not ended.is_set():
        client.loop(_POLL_S)
    client.disconnect()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
