"""A robot as an engineer would build it with paho alone.

Program: ``python -m pebble.extensions.lab.bench.stand_in bridge|serial …``.

What a user would have without Pebble, after the paper's description of the original; not the original's code, which is
not here. One process forwards between two brokers: a client on each side, whose ``on_message`` publishes on the other.
Another owns the serial line: drive commands become lines at once, reports become messages. Neither watches how old a
command is, bounds a queue, or stops the motors when commands end.
"""

from __future__ import annotations

import itertools
import json
import sys
import time

import serial
from paho.mqtt.client import MQTTMessage

from pebble.contract import DRIVE, INCOMING, ONLINE, OUTGOING, STATUS, TOUCH_SENSORS
from pebble.extensions.lab.bench.clients import StockClient

_BAUD = 460_800
_HEARTBEAT_S = 0.25  # as a robot of ours, so that both carry the same
_STATUS_EVERY = 4  # heartbeats
_READ_S = 1.0
_PIECE = 4096  # bytes
_TOUCH = ("a0", "a1", "a2")


def bridge(remote_port: int, local_port: int, base: str) -> None:
    """Forward commands to the local broker, everything else to the remote one; publish heartbeats."""
    remote = StockClient(lambda message: local.publish(message), [(f"{base}/{INCOMING}/#", 1)], at_once=False)
    local = StockClient(remote.publish, [(f"{base}/{OUTGOING}/#", 1)], at_once=False)
    remote.open(remote_port)
    local.open(local_port)
    for number in itertools.count():
        if number % _STATUS_EVERY == 0:
            remote.send(STATUS, base, {"value": {"services": {"bridge": {"state": "ready"}}}})
        remote.send(ONLINE, base, {"t": round(1000 * time.time())})
        time.sleep(_HEARTBEAT_S)


def serial_bridge(local_port: int, base: str, device: str, *, reports: bool) -> None:
    """Write a line for each drive command; with ``reports`` publish the touch sensors' reports."""
    port = serial.Serial(device, _BAUD, timeout=_READ_S)

    def drive(message: MQTTMessage) -> None:
        command = json.loads(message.payload)
        left, right = command["z"] + command["x"], command["z"] - command["x"]
        port.write(b"M %.3f %.3f\n" % (max(-1.0, min(1.0, left)), max(-1.0, min(1.0, right))))

    local = StockClient(drive, [(DRIVE.topic(base), 1)], at_once=False).open(local_port)
    unfinished = b""
    while True:  # without pyserial's own readline, which reads byte by byte
        data = unfinished + port.read(max(1, min(port.in_waiting, _PIECE)))
        *lines, unfinished = data.split(b"\n")
        if not reports:
            continue
        for line in lines:
            fields = dict(token.split("=", 1) for token in line.decode().split() if "=" in token)
            if all(name in fields for name in _TOUCH):
                local.send(TOUCH_SENSORS, base, {"value": {name: int(fields[name]) for name in _TOUCH}})


if __name__ == "__main__":
    # ports of the two brokers, the base of the robot's topics, its serial line, and whether reports are published
    part, local_port, remote_port, topics, device, *options = sys.argv[1:]
    if part == "bridge":
        bridge(int(remote_port), int(local_port), topics)
    else:
        serial_bridge(int(local_port), topics, device, reports="--reports" in options)
