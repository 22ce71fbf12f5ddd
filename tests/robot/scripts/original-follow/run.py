"""A stand-in for a script of the original Pebble, without any of its code: ``python original_follow.py --config FILE``.

It has the shape of apriltag-odom-follow: options by argparse, paho to ``local_mqtt`` of the config, drive commands that
are not signed, and no final stop when SIGTERM ends it. It follows the tag in ``apriltag-locations`` at the distance
that the tag's size on the picture gives, and turns while it sees none.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from pathlib import Path
from typing import Any

import paho.mqtt.client as paho

FOCAL = 624 / 640  # in widths of the picture: the original's calibration
LOST_S = 0.5


def main() -> None:
    options = follow_options().parse_args()
    config = json.loads(Path(options.config).read_text())
    robot, broker = config["robot"], config["local_mqtt"]
    base = f"{robot.get('system', 'pebble')}/{robot.get('type', 'robots')}/{robot['id']}"
    script = Follow(options)
    version = getattr(paho, "CallbackAPIVersion", None)  # of paho 2
    client: Any = paho.Client(*(() if version is None else (version.VERSION2,)), client_id=f"{base}-follow")
    if broker.get("username"):
        client.username_pw_set(broker["username"], broker.get("password"))
    client.on_connect = lambda *_: client.subscribe(
        [(f"{base}/outgoing/apriltag-locations", 0), (f"{base}/outgoing/wheel-odometry", 0)]
    )
    client.on_message = lambda _client, _data, message: script.receive(message.topic, json.loads(message.payload))
    client.connect(broker.get("host", "127.0.0.1"), broker.get("port", 1883), 30)
    client.loop_start()
    while True:
        found, drive = script.step(time.monotonic())
        client.publish(f"{base}/outgoing/apriltag-data", json.dumps({**found, "timestamp": time.time()}))
        client.publish(f"{base}/incoming/drive-values", json.dumps(drive), qos=options.qos, retain=options.retain)
        time.sleep(1 / options.control_rate_hz)


def follow_options() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument("--config", required=True)
    parser.add_argument("--tag-id", type=int, default=13)
    parser.add_argument("--tag-size-m", type=float, default=0.25)
    parser.add_argument("--target-distance-m", type=float, default=0.6)
    parser.add_argument("--control-rate-hz", type=float, default=10.0)
    parser.add_argument("--search-power", type=float, default=0.25)
    parser.add_argument("--qos", type=int, default=0)
    parser.add_argument("--retain", action="store_true")
    return parser


class Follow:
    """What it has received, and what it drives."""

    def __init__(self, options: argparse.Namespace) -> None:
        self._options = options
        self._seen: tuple[float, float, float, list[Any]] | None = None  # when, distance, angle, corners
        self.odometry: dict[str, Any] = {}

    def receive(self, topic: str, payload: dict[str, Any]) -> None:
        if topic.endswith("wheel-odometry"):
            self.odometry = payload["value"]
            return
        width, height = payload.get("frame_width") or 640, payload.get("frame_height") or 480
        for tag in payload["detections"]:
            if tag["marker_id"] == self._options.tag_id:
                corners = [(x * width, y * height) for x, y in tag["corners_norm"]]
                pixels = sum(math.dist(corners[i - 1], corners[i]) for i in range(4)) / 4
                distance = FOCAL * width * self._options.tag_size_m / max(pixels, 1.0)
                angle = math.atan((tag["center_norm"][0] - 0.5) / FOCAL)
                self._seen = time.monotonic(), distance, angle, tag["corners_norm"]

    def step(self, now: float) -> tuple[dict[str, Any], dict[str, float]]:
        """What it reports, and what it drives."""
        if self._seen is None or now - self._seen[0] > LOST_S:
            nothing = {"detected": False, "marker_id": None, "corners_norm": [], "distance_m": None, "angle_rad": None}
            return nothing, {"x": self._options.search_power, "z": 0.0}
        _, distance, angle, corners = self._seen
        found = {"detected": True, "marker_id": self._options.tag_id, "corners_norm": corners}
        error = distance - self._options.target_distance_m
        drive = {
            "x": 0.6 * angle if abs(angle) > 0.03 else 0.0,
            "z": max(-0.6, min(0.6, 1.5 * error)) if abs(error) > 0.05 else 0.0,
        }
        return {**found, "distance_m": distance, "angle_rad": angle}, drive


if __name__ == "__main__":
    main()
