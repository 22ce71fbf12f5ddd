"""A robot for a board with MicroPython, such as an ESP32 or a Pico W.

Copy it to the board as main.py, with the modules beside it and a settings.py of your own:

    WIFI, WIFI_PASSWORD = "my network", "its password"
    ID, HOST, PORT = "mine", "broker.example", 1883
    STOP_FILE = "/stop.json"
    LOGIN = ()  # at level named: (user, password, the certificate of the broker's authority as text)
"""

import json
import os
import time

import network
from duties import Robot
from mqtt import Mqtt
from settings import HOST, ID, LOGIN, PORT, STOP_FILE, WIFI, WIFI_PASSWORD

STEP_MS = 20
RETRY_MS = 200
EPOCH_S = 0 if time.gmtime(0)[0] == 1970 else 946684800  # some boards count from 2000


class MyRobot(Robot):
    """The parts of a robot that differ from board to board."""

    def __init__(self):
        self.ticks = time.ticks_ms()
        self.clock = 0
        super().__init__(ID, bool(LOGIN), saved())

    def turn(self, left, right):
        """Set the pins of your motors here. It must not raise OSError, which means "not connected" below.

        It is called in every round while at rest: write to the hardware only on a change.
        """

    def publish(self, metric, value, qos):
        client.publish(self.base + "/outgoing/" + metric, value, qos)

    def save(self, text):
        """Write a new file, then let it replace the old one: a power cut leaves one of them."""
        with open(STOP_FILE + ".new", "w") as file:
            file.write(text)
        os.rename(STOP_FILE + ".new", STOP_FILE)

    def now(self):
        """Return milliseconds since the start. The board's own counter begins again every few days."""
        ticks = time.ticks_ms()
        self.clock += time.ticks_diff(ticks, self.ticks)
        self.ticks = ticks
        return self.clock

    def epoch_ms(self):
        return time.time_ns() // 1000000 + EPOCH_S * 1000


def saved():
    """Return the saved text; None if there is no file, "" if it cannot be read."""
    folder, _, name = STOP_FILE.rpartition("/")
    if name not in os.listdir(folder or "/"):
        return None
    try:
        with open(STOP_FILE) as file:
            return file.read()
    except (OSError, UnicodeError):
        return ""


def set_clock():
    """Set the clock by the internet: people are shown how old messages are.

    The robot drives without it, too, but the times in its messages then count from the start of the board.
    """
    if time.gmtime()[0] < 2024:
        import ntptime

        try:
            ntptime.settime()
        except OSError:  # no internet, or no answer
            if LOGIN:
                raise  # a certificate cannot be checked without the date


def connect():
    set_clock()
    client.open()
    client.subscribe(robot.base + "/incoming/#")
    robot.connected()
    print("connected")


wifi = network.WLAN(network.STA_IF)
wifi.active(True)
wifi.connect(WIFI, WIFI_PASSWORD)
robot = MyRobot()
will = (robot.base + "/outgoing/online", json.dumps({"t": robot.epoch_ms(), "online": False}))
client = Mqtt(HOST, PORT, "robot-" + ID, LOGIN, will)

try:
    while True:
        try:
            for topic, payload, retained in client.messages(STEP_MS):
                robot.receive(topic, payload, retained)
        except OSError:  # not connected
            robot.halt()  # before connecting, which may take seconds
            time.sleep_ms(RETRY_MS)
            try:
                connect()
            except OSError as error:  # no network, or no broker: it tries again
                print("not connected:", error)
                client.close()
        robot.tick()
finally:
    robot.halt()  # an error in this program must not leave the motors running
