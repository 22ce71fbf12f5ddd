"""The lower limit of a robot's start and memory: one process with a local transport and a connection to operators.

It runs as a plain file, and imports nothing of Pebble: ``floor.py LOCAL REMOTE_PORT ONLINE STATUS``. LOCAL is the port
of a local broker, or the path of a Unix socket on which Zenoh listens; ONLINE and STATUS are topics.
"""

import json
import sys
import threading
import time
from typing import Any

from paho.mqtt.client import Client
from paho.mqtt.enums import CallbackAPIVersion

#: As sessions of robots: nothing waits for, or is found by, multicast.
_SCOUTING = {"delay": 1, "multicast": {"enabled": False}, "gossip": {"enabled": False}}
_HEARTBEAT_S = 0.25


def connected(port: int) -> Client:
    """Return a client once a broker has accepted it."""
    client, accepted = Client(CallbackAPIVersion.VERSION2), threading.Event()
    client.on_connect = lambda *_: accepted.set()
    client.connect("127.0.0.1", port)
    client.loop_start()
    accepted.wait()
    return client


def open_zenoh(socket: str) -> Any:
    import zenoh

    listen = {"endpoints": [f"unixsock-stream/{socket}"]}
    return zenoh.open(zenoh.Config.from_json5(json.dumps({"listen": listen, "scouting": _SCOUTING})))


def main(place: str, remote_port: str, online: str, status: str) -> None:
    _local = connected(int(place)) if place.isdigit() else open_zenoh(place)  # open as long as this runs
    remote = connected(int(remote_port))
    while True:
        remote.publish(online, json.dumps({"t": round(1000 * time.time())}), 1, retain=True)
        services = {"floor": {"state": "ready"}}
        remote.publish(status, json.dumps({"value": {"services": services}}), 1, retain=True)
        time.sleep(_HEARTBEAT_S)


if __name__ == "__main__":
    main(*sys.argv[1:])
