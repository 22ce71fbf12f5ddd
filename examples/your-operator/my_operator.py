"""Drives a robot by the lines that a person types. It needs paho-mqtt 2 or newer, in a venv,
and the modules beside it:

    python my_operator.py ID HOST PORT [USER PASSWORD_FILE CA_FILE]

"0 0.5" steers by 0 and drives at 0.5 until the next line, "0 0" or an empty line lets go, "stop" and "reset" are the
emergency stop, Ctrl-D ends it. With a user, commands carry this name. (operator.py would hide a module of Python.)
"""

import json
import queue
import secrets
import signal
import sys
import threading
import time
from pathlib import Path

import paho.mqtt.client as mqtt
from driver import Driver, numbers
from robot_state import METRICS, RobotState

ID, HOST, PORT, *LOGIN = sys.argv[1:]
NAME = LOGIN[0] if LOGIN else "sample"
BASE = f"pebble/robots/{ID}"
PLAIN = f"{BASE}/incoming/"
INCOMING = f"{PLAIN}by/{NAME}/" if LOGIN else PLAIN
STEP_S = 0.01
KEEPALIVE_S = 5
RETRY_S = 0.5
REPEATS_S = 0.5
GIVES_UP_S = 60.0
MOST_TEXTS = 1000  # that wait to be printed


class StopSender:
    """An emergency stop, repeated until each owner of motors has confirmed it."""

    def __init__(self):
        self.stop = {"stop": secrets.token_hex(8), "by": NAME}
        self.due_at = time.monotonic()
        self.ends_at = self.due_at + GIVES_UP_S

    def is_over(self):
        return robot.has_stop(self.stop["stop"]) or time.monotonic() > self.ends_at

    def step(self):
        if time.monotonic() >= self.due_at:
            self.due_at = time.monotonic() + REPEATS_S
            for base in {PLAIN, INCOMING}:  # a stop counts without a name as well
                client.publish(base + "estop", json.dumps(self.stop), qos=1)


class Output:
    """Standard output on a thread of its own: a terminal that stands still must delay no stop."""

    def __init__(self):
        self.texts = queue.SimpleQueue()
        self.thread = threading.Thread(target=self.show, args=[sys.stdout], daemon=True)
        self.thread.start()

    def write(self, text):
        if self.texts.qsize() < MOST_TEXTS:
            self.texts.put(text)

    def flush(self):
        """Do nothing: the thread flushes."""

    def show(self, stream):
        for text in iter(self.texts.get, None):
            stream.write(text)
            stream.flush()

    def close(self):
        self.texts.put(None)
        self.thread.join(1.0)


def send(metric, value, qos):
    """Publish a command, never retained: otherwise the robot would carry it out at every start."""
    client.publish(INCOMING + metric, json.dumps(value), qos)


def reset():
    """End the stops that are shown now, and no later ones."""
    for state in robot.known(robot.stops).values():
        send("estop-reset", {"boot": state.get("boot"), "count": state.get("count")}, 1)


def on_connect(_client, _data, _flags, reason, _properties):
    print("the broker answers:", reason, flush=True)
    client.subscribe([(f"{BASE}/outgoing/{metric}", 1) for metric in METRICS])


def on_message(_client, _data, message):
    robot.receive(message.topic.removeprefix(f"{BASE}/outgoing/"), message.payload, message.retain)


def read_lines():
    for line in sys.stdin:
        lines.put(line.strip() or "0 0")
    lines.put(None)


sys.stdout = Output()
robot = RobotState()
driver = Driver(robot, NAME, send)
stop = None
lines = queue.SimpleQueue()
client = mqtt.Client(mqtt.CallbackAPIVersion.VERSION2)
client.on_connect = on_connect
client.on_message = on_message
if LOGIN:
    _, password_file, ca_file = LOGIN
    client.username_pw_set(NAME, Path(password_file).read_text().strip())
    client.tls_set(ca_file)
client.connect_async(HOST, int(PORT), KEEPALIVE_S)
signal.signal(signal.SIGINT, lambda *_: lines.put(None))  # Ctrl-C lets go as well
threading.Thread(target=read_lines, daemon=True).start()

typed = ""
while typed is not None:
    if client.loop(STEP_S) != mqtt.MQTT_ERR_SUCCESS:  # not connected
        robot.disconnect()
        time.sleep(RETRY_S)
        try:
            client.reconnect()
        except OSError as error:  # no network, or no broker: it tries again
            print(error, flush=True)
    typed = "" if lines.empty() else lines.get()
    if typed == "stop":
        stop = StopSender()
    elif typed == "reset":
        reset()
    elif typed:
        driver.push(*numbers(typed))
    if stop and stop.is_over():
        print("the robot is stopped" if robot.has_stop(stop.stop["stop"]) else "the stop is not confirmed", flush=True)
        stop = None
    if stop:
        stop.step()
    driver.step(is_stopping=stop is not None)

driver.push(0.0, 0.0)
driver.release()
for _ in range(30):
    client.loop(STEP_S)
sys.stdout.close()
