"""A fake rpicam-vid: the synthetic scene on stdout, as JPEG pictures or raw planes.

``FAKE`` in the environment: ``quiet`` (sends nothing), ``refuses`` (ends at once, with a complaint).
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from itertools import count

import cv2
import numpy as np

from pebble.extensions.media.scene import Scene
from tests.fakes.installed import signed_in


def main() -> None:
    parser = argparse.ArgumentParser()
    for name in ("width", "height", "framerate"):
        parser.add_argument(f"--{name}", type=float, required=True)
    parser.add_argument("--codec", choices=["mjpeg"], required=True)
    options, _others = parser.parse_known_args()
    kind = os.environ.get("FAKE", "")
    if kind == "refuses":
        sys.exit("ERROR: *** no cameras available ***")
    width, height = int(options.width), int(options.height)
    scene, picture = Scene(width, height), np.empty((height, width, 3), np.uint8)
    begin = time.monotonic()
    for number in count():
        if kind == "quiet":
            time.sleep(1000)
        scene.render(number, picture)
        sys.stdout.buffer.write(cv2.imencode(".jpg", picture)[1].tobytes())
        sys.stdout.buffer.flush()
        time.sleep(max(0.0, begin + (number + 1) / options.framerate - time.monotonic()))


if __name__ == "__main__":
    signed_in()
    main()
