"""A recording with real pictures of every encoding, whose numbers can be read from them, as a recorder's folder."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from pebble.extensions.media.scene import Scene
from pebble.extensions.media.video import make_encoder
from tests.ext.recordings.playing import GOOB, Line, demo, js, ms, write

FPS = 15
SIZE = (320, 240)
SCENES = 60  # after which pictures repeat: drawing takes longer than all else
CAMERA = f"{GOOB}/outgoing/front-camera"


def pictures(encoding: str, seconds: float) -> Iterator[Line]:
    """The number in a picture is its own modulo SCENES."""
    encoder = make_encoder(encoding, fps=FPS, quality=60, keyframe_interval=2 * FPS)
    scene, made = Scene(*SIZE), list[np.ndarray]()
    for number in range(SCENES):
        made.append(np.empty((SIZE[1], SIZE[0], 3), np.uint8))
        scene.render(number, made[-1])
    for number in range(int(seconds * FPS)):
        at = number / FPS
        payload = encoder.encode(made[number % SCENES], ms(at))
        if payload is not None:
            yield Line(at, CAMERA, payload)


def film(root: Path, encoding: str, seconds: float, *, finished: bool = True) -> Path:
    """A folder as a recorder leaves it: one file of state, one of media, a chunk each second."""
    day = root / "2023/11/14"
    day.mkdir(parents=True)
    capabilities = js(t=ms(0), value={"video": {"available": True}})
    offered = Line(0.0, f"{GOOB}/outgoing/capabilities", capabilities, 1, retain=True)
    shown = [offered, *demo(seconds, [GOOB]), *pictures(encoding, seconds)]
    lines = sorted(shown, key=lambda line: line.at)
    media = [line for line in lines if line.topic in (CAMERA, f"{GOOB}/outgoing/audio")]
    state = [line for line in lines if line.topic not in (CAMERA, f"{GOOB}/outgoing/audio")]
    suffix = ".mcap" if finished else ".mcap.active"
    write(day / f"20231114T221320Z-000001.state{suffix}", state, finished=finished, chunk_ns=10**9)
    name = f"20231114T221320Z-000002.media.{GOOB.replace('/', '.')}{suffix}"
    write(day / name, media, finished=finished, chunk_ns=10**9)
    return root
