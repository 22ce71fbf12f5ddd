"""A robot as an engineer would build it with paho alone.

Program: ``python -m pebble.extensions.lab.bench.stand_in bridge|serial …``.

What a user would have without us, after the description of the original in the paper; not the original's code, which is
not here. One process forwards between two brokers: a client on each side, whose ``on_message`` publishes on the other.
Another owns the serial line: drive commands become lines at once, reports become messages. Neither watches how old a
command is, bounds a queue, or stops the motors when commands end.
"""

from __future__ import annotations

import itertools
import json
import sys
import time
from typing import Any

import serial
from paho.mqtt.client import Client, MQTTMessage
from paho.mqtt.enums import CallbackAPIVersion

from pebble.contract import DRIVE, INCOMING, ONLINE, OUTGOING, STATUS, TOUCH_SENSORS

_BAUD = 460_800
_HEARTBEAT_S = 0.25  # as a robot of ours, so that both carry the same
_STATUS_EVERY = 4  # heartbeats
_READ_S = 1.0
_PIECE = 4096  # bytes
_TOUCH = ("a0", "a1", "a2")


def client(port: int, *filters: str) -> Any:
    """Connected, on a thread of its own, and subscribed to ``filters`` with QoS 1."""
    made: Any = Client(CallbackAPIVersion.VERSION2)
    made.on_connect = lambda *_: made.subscribe([(filter_, 1) for filter_ in filters])
    made.connect("127.0.0.1", port)
    return made


def bridge(remote_port: int, local_port: int, base: str) -> None:
    """Forwards commands to the local broker, everything else to the remote one; publishes heartbeats."""
    remote, local = client(remote_port, f"{base}/{INCOMING}/#"), client(local_port, f"{base}/{OUTGOING}/#")

    def forward(to: Client) -> Any:
        return lambda _client, _data, one: to.publish(one.topic, one.payload, one.qos, one.retain)

    remote.on_message, local.on_message = forward(local), forward(remote)
    for one in (remote, local):
        one.loop_start()
    state = {"value": {"services": {"bridge": {"state": "ready"}}}}
    for number in itertools.count():
        if number % _STATUS_EVERY == 0:
            remote.publish(STATUS.topic(base), json.dumps(state), 1, True)
        remote.publish(ONLINE.topic(base), json.dumps({"t": round(1000 * time.time())}), 1, True)
        time.sleep(_HEARTBEAT_S)


def serial_bridge(local_port: int, base: str, device: str, *, reports: bool) -> None:
    """Writes a line for each drive command, and with ``reports`` publishes each one of the touch sensors."""
    port = serial.Serial(device, _BAUD, timeout=_READ_S)

    def drive(_client: Client, _data: Any, message: MQTTMessage) -> None:
        wanted = json.loads(message.payload)
        left, right = (max(-1.0, min(1.0, wanted["z"] + side * wanted["x"])) for side in (1, -1))
        port.write(b"M %.3f %.3f\n" % (left, right))

    local = client(local_port, DRIVE.topic(base))
    local.on_message = drive
    local.loop_start()
    rest = b""
    while True:  # without pyserial's own readline, which reads byte by byte
        *lines, rest = (rest + port.read(max(1, min(port.in_waiting, _PIECE)))).split(b"\n")
        for line in lines if reports else ():
            fields = dict(token.split("=", 1) for token in line.decode().split() if "=" in token)
            if all(name in fields for name in _TOUCH):
                touch = {name: int(fields[name]) for name in _TOUCH}
                local.publish(TOUCH_SENSORS.topic(base), json.dumps({"value": touch}), TOUCH_SENSORS.default_qos)


if __name__ == "__main__":
    # ports of the two brokers, the base of the robot's topics, its serial line, and whether reports are published
    part, local_port, remote_port, topics, device, *options = sys.argv[1:]
    if part == "bridge":
        bridge(int(remote_port), int(local_port), topics)
    else:
        serial_bridge(int(local_port), topics, device, reports="--reports" in options)
