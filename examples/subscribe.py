"""Prints the battery of every robot of a broker: python subscribe.py 127.0.0.1 1883"""

import json
import sys
import threading

from pebble.contract import CHARGING_LEVEL
from pebble.transports import Message, MqttSettings, create


def show(message: Message) -> None:
    level = json.loads(message.payload)
    _, _, robot, *_ = message.topic.split("/")
    print(f"{robot}: {level['value']} {level['unit']}", flush=True)


if __name__ == "__main__":
    host, port = sys.argv[1:]
    with create("mqtt", "battery-printer", MqttSettings(host=host, port=int(port))) as bus:
        bus.subscribe(CHARGING_LEVEL.filter("pebble/robots/+"), show)
        threading.Event().wait()
