"""What the stand-ins for scripts of the original have in common, without any code of it: config, paho, local media.

They import nothing of Pebble, and run with the system's Python, whose OpenCV has GStreamer.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import paho.mqtt.client as paho

RETRY_S = 2.0


class Robot:
    """The config that ``--config`` names, and a client at its ``local_mqtt``."""

    def __init__(self, path: str, name: str) -> None:
        self.config = json.loads(Path(path).read_text())
        robot = self.config["robot"]
        self.base = f"{robot.get('system', 'pebble')}/{robot.get('type', 'robots')}/{robot['id']}"
        version = getattr(paho, "CallbackAPIVersion", None)  # of paho 2
        arguments = () if version is None else (version.VERSION2,)
        self.client: Any = paho.Client(*arguments, client_id=f"{self.base}-{name}")

    @property
    def video(self) -> dict[str, Any]:
        return dict(self.config["services"]["av_daemon"]["video"])

    def connect(self) -> None:
        broker = self.config["local_mqtt"]
        if broker.get("username"):
            self.client.username_pw_set(broker["username"], broker.get("password"))
        self.client.connect(broker.get("host", "127.0.0.1"), broker.get("port", 1883), 30)
        self.client.loop_start()

    def publish(self, suffix: str, body: dict[str, Any], qos: int = 0) -> None:
        self.client.publish(f"{self.base}/{suffix}", json.dumps({**body, "timestamp": time.time()}), qos=qos)


def pictures(video: dict[str, Any]) -> Iterator[Any]:
    """The camera's, for ever; after a loss the socket is opened again, 2 s later."""
    path, width, height, fps = video["socket_path"], video["width"], video["height"], video["fps"]
    while True:
        yield from _read(path, width, height, fps)
        print("source unavailable", flush=True)  # noqa: T201 - a script's output is its log
        time.sleep(RETRY_S)


def _read(path: str, width: int, height: int, fps: int) -> Iterator[Any]:
    capture = cv2.VideoCapture(
        f"shmsrc socket-path={path} is-live=true do-timestamp=true ! "
        f"video/x-raw,format=BGR,width={width},height={height},framerate={fps}/1 ! appsink max-buffers=1 drop=true",
        cv2.CAP_GSTREAMER,
    )
    try:
        while capture.isOpened():
            ok, picture = capture.read()
            if not ok:
                return
            yield picture
    finally:
        capture.release()


class Tags:
    """Finds them as the payload of ``apriltag-locations`` has them."""

    def __init__(self) -> None:
        dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_25h9)
        if hasattr(cv2.aruco, "ArucoDetector"):
            self._detect = cv2.aruco.ArucoDetector(dictionary).detectMarkers
        else:  # OpenCV before 4.7
            self._detect = lambda grey: cv2.aruco.detectMarkers(grey, dictionary)

    def find(self, picture: Any) -> dict[str, Any]:
        height, width = picture.shape[:2]
        corners, ids, _ = self._detect(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY))
        found = []
        for four, number in zip(corners, [] if ids is None else np.ravel(ids), strict=False):
            norm = four.reshape(4, 2) / (width, height)
            found.append(
                {"marker_id": int(number), "corners_norm": norm.tolist(), "center_norm": norm.mean(axis=0).tolist()}
            )
        return {"source": "stand-in", "detections": found, "frame_width": width, "frame_height": height}
