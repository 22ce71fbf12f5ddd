"""A stand-in for a script of the original Pebble, without any of its code: ``python run.py --config FILE``.

It has the shape of apriltag-odom-follow: options by argparse, paho to ``local_mqtt`` of the config, drive commands that
are not signed, and no final stop when SIGTERM ends it. It sees no tag, so it turns on the spot.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import paho.mqtt.client as paho


def main() -> None:
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument("--config", required=True)
    config = json.loads(Path(parser.parse_args().config).read_text())
    robot, broker = config["robot"], config["local_mqtt"]
    base = f"{robot.get('system', 'pebble')}/{robot.get('type', 'robots')}/{robot['id']}"
    version = getattr(paho, "CallbackAPIVersion", None)  # of paho 2
    client: Any = paho.Client(*(() if version is None else (version.VERSION2,)), client_id=f"{base}-follow")
    client.connect(broker.get("host", "127.0.0.1"), broker.get("port", 1883), 30)
    client.loop_start()
    while True:
        client.publish(f"{base}/incoming/drive-values", json.dumps({"x": 0.25, "z": 0.0}))
        time.sleep(0.1)


if __name__ == "__main__":
    main()
