"""``apriltag-follow``, which also records the capture of each picture and the drive command published after it."""

import os
import runpy
import time
from pathlib import Path
from typing import Any

import pebble.script
from pebble.cameras import Camera, Picture
from pebble.transports import Transport
from pebble.transports.frames import Frame

FOLLOW = Path(pebble.__file__).parent / "extensions/scripts/shipped" / "apriltag-follow" / "run.py"
_picture, _publish = Camera._picture, Transport.publish
captured_ns = 0


def picture(camera: Camera, frame: Frame) -> Picture:
    global captured_ns
    captured_ns = frame.info.captured_ns
    return _picture(camera, frame)


def publish(transport: Transport, topic: str, *arguments: Any, **options: Any) -> bool:
    if topic.endswith("/drive-values") and captured_ns:
        with Path(os.environ["TIMING"]).open("a") as file:
            file.write(f"{captured_ns} {time.monotonic_ns()}\n")
    return _publish(transport, topic, *arguments, **options)


Camera._picture, Transport.publish = picture, publish
runpy.run_path(str(FOLLOW), run_name="__main__")
