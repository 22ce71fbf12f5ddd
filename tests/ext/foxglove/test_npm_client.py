"""The client that Foxglove publishes on npm, @foxglove/ws-protocol, understands the server."""

from __future__ import annotations

import base64
import json
import subprocess
import time
from pathlib import Path
from typing import Any

from tests.ext.foxglove.live import live
from tests.ext.foxglove.test_pictures import H264, JPEG, WITHDRAWN, filming, nal_types
from tests.ext.foxglove.watcher import Watcher, parser
from tests.kit.npm import package
from tests.support import Broker, until


def watch(address: str, topic: str, count: int) -> dict[str, Any]:
    package("@foxglove/ws-protocol")
    watcher = Watcher(address)
    assert until(lambda: topic in watcher.channels)
    watcher.close()
    command = ["node", str(Path(__file__).with_name("client.cjs")), address, topic, str(count)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
    assert (done.returncode, done.stderr) == (0, "")
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def test_it_sees_compressed_video(broker: Broker) -> None:
    with filming(broker) as robot, live(broker) as server:
        found = watch(server.address, H264, 20)
        assert until(lambda: robot.requests[-1] == WITHDRAWN, 20)
    assert {H264, JPEG} <= set(found["topics"])
    assert (found["info"]["name"], found["info"]["capabilities"]) == ("Pebble", [])
    kind = parser(found["channel"])
    videos = [kind.FromString(base64.b64decode(message["data"])) for message in found["messages"]]
    assert {5, 7, 8} <= set(nal_types(videos[0].data))
    assert all(abs(int(message["at"]) / 1e9 - time.time()) < 60 for message in found["messages"])
