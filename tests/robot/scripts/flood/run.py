"""Publishes 500 drive commands a second, which `robot.drive` would not, until a signal ends the process."""

import os
import sys
import time

import pebble.script  # noqa: F401 - so that it gets a number
from pebble.config import load
from pebble.contract import DRIVE, codec
from pebble.contract.payloads import SCRIPT, Drive
from pebble.runtime.addresses import Addresses
from pebble.runtime.connections import local_transport

if "--describe" in sys.argv:
    sys.stdout.write('{"label": "flood", "configs": [], "dependencies": []}')
    sys.exit()
config = load(os.environ["PEBBLE_CONFIG"])
topic = Addresses(config)[DRIVE].topic
payload = codec.encode(DRIVE, Drive(z=0.3, source=SCRIPT, run=int(os.environ["PEBBLE_RUN"])))
with local_transport(config, "flood") as transport:
    due = time.monotonic()
    while True:
        transport.publish(topic, payload)
        due += 0.002
        time.sleep(max(0.0, due - time.monotonic()))
