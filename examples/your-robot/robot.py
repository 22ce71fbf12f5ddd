"""A robot for a computer with Python, such as a Raspberry Pi. It needs paho-mqtt 2 or newer, in a venv.

    python robot.py ID HOST PORT STOP_FILE [USER PASSWORD_FILE CA_FILE]

The program needs the modules beside it as well.
With USER it runs at security level `named` (docs/ext/fleet.md): it obeys only commands that carry the account of their
sender.
"""

import json
import os
import signal
import sys
import time
from pathlib import Path

import paho.mqtt.client as mqtt
from duties import Robot

ID, HOST, PORT, STOP_FILE, *LOGIN = sys.argv[1:]
STEP_S = 0.02
KEEPALIVE_S = 5  # after 7.5 s of silence the broker publishes that the robot is gone
RETRY_S = 0.2


class MyRobot(Robot):
    """The parts of a robot that differ from computer to computer."""

    said = ""  # about the connection

    def turn(self, left, right):
        """Set the pins of your motors here.

        It is called in every round while at rest: write to the hardware only on a change.
        """

    def publish(self, metric, value, qos):
        client.publish(self.base + "/outgoing/" + metric, json.dumps(value), qos, retain=True)

    def save(self, text):
        """Write a new file, then let it replace the old one: a power cut leaves one of them."""
        new = Path(STOP_FILE + ".new")
        with new.open("w") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        new.replace(STOP_FILE)

    def now(self):
        return time.monotonic_ns() // 1_000_000

    def epoch_ms(self):
        return time.time_ns() // 1_000_000

    def say(self, text):
        """Print a text, unless it was printed last: connecting is tried five times a second."""
        if text != self.said:
            print(text, flush=True)
        self.said = text


def saved():
    """Return the saved text; None if there is no file, "" if it cannot be read."""
    try:
        return Path(STOP_FILE).read_text(errors="replace")
    except FileNotFoundError:
        return None
    except OSError:
        return ""


def on_connect(_client, _data, _flags, reason, _properties):
    if reason.is_failure:
        robot.say(f"the broker refuses the connection: {reason}")
        return
    robot.say("connected")
    client.subscribe(robot.base + "/incoming/#", qos=1)
    robot.connected()


def on_message(_client, _data, message):
    robot.receive(message.topic, message.payload, message.retain)


robot = MyRobot(ID, bool(LOGIN), saved())
client = mqtt.Client(mqtt.CallbackAPIVersion.VERSION2)
client.on_connect = on_connect
client.on_message = on_message
# What the broker publishes when the connection is lost:
gone = json.dumps({"t": robot.epoch_ms(), "online": False})
client.will_set(robot.base + "/outgoing/online", gone, qos=1, retain=True)
if LOGIN:
    user, password_file, ca_file = LOGIN
    client.username_pw_set(user, Path(password_file).read_text().strip())
    client.tls_set(ca_file)
client.connect_async(HOST, int(PORT), KEEPALIVE_S)

signal.signal(signal.SIGTERM, lambda *_: sys.exit())  # as systemd ends it: else the motors would run on
try:
    while True:
        if client.loop(STEP_S) != mqtt.MQTT_ERR_SUCCESS:  # not connected
            robot.halt()  # before connecting, which may take seconds
            time.sleep(RETRY_S)
            try:
                client.reconnect()
            except OSError as error:  # no network, or no broker: it tries again
                robot.say(f"not connected: {error}")
        robot.tick()
finally:
    robot.halt()  # Ctrl-C, or an error in this program, must not leave the motors running
