"""Drives a robot by a stick: asks for control, sends commands while the stick is pushed, and gives control back."""

import math
import secrets
import time

ASKS_S = 1.0  # control ends unless it is asked for again and again
KEEPS_S = 3.0  # so long after the last command it is given back


class Driver:
    """A person at a robot. ``send(metric, value, qos)`` publishes below incoming/."""

    def __init__(self, robot, name, send):
        self.robot = robot  # what is known of it, see robot_state.py
        self.id = secrets.token_hex(4)
        self.name = name
        self.send = send
        self.stick = (0.0, 0.0)  # x steers, z drives
        self.is_moving = False
        self.must_let_go = False  # a stick that is held down must not drive on later
        self.moved_at = self.asked_at = self.sent_at = -math.inf

    def push(self, x, z):
        """Move the stick to this position; a value that is no number releases it."""
        if not (math.isfinite(x) and math.isfinite(z)):
            x = z = 0.0
        self.stick = (max(-1.0, min(1.0, x)), max(-1.0, min(1.0, z)))
        if not any(self.stick):
            self.must_let_go = self.is_moving = False
            key = self.robot.key(self.id)
            self.send("drive-values", {"x": 0, "z": 0, "key": key} if key else {"x": 0, "z": 0}, 1)

    def step(self, is_stopping):
        """Continue; call this often. ``is_stopping``: an emergency stop was pressed, and is not confirmed yet."""
        now = time.monotonic()
        pushed = any(self.stick)
        if pushed and not self.must_let_go and (why := self.why_not(is_stopping)):
            print(why, flush=True)
            self.must_let_go = True
            self.is_moving = False
        if pushed and not self.must_let_go:
            self.moved_at = now
        if self.robot.gives_control():
            self.keep_control(now)
        may_move = self.robot.key(self.id) or not self.robot.gives_control()
        if pushed and not self.must_let_go and may_move:
            self.send_stick(now)

    def why_not(self, is_stopping):
        """Return why nothing may move; empty if it may."""
        if self.robot.is_silent():
            return "the robot is silent"
        if self.robot.is_stopped() or is_stopping:
            return "the robot is stopped"
        if self.is_moving and self.robot.gives_control() and not self.robot.key(self.id):  # it lost the key
            return "another has control now"
        return ""

    def keep_control(self, now):
        """Ask for control every ASKS_S, which also prolongs it; release it KEEPS_S after the stick was last pushed."""
        if now >= self.moved_at + KEEPS_S:
            if self.robot.key(self.id):
                self.release()
        elif now >= self.asked_at + ASKS_S:
            self.asked_at = now
            self.request("hold")
            self.robot.show_holder(self.id)  # prints who has control, if that is another client

    def release(self):
        self.request("release")
        self.robot.controls = {}

    def request(self, want):
        request = {"id": self.id, "want": want, "for_ms": 3000, "by": self.name, "device": "sample"}
        if not self.robot.is_wide():
            request |= {"for_ms": 10_000, "t": clock_ms()}
        self.send("control", request, 1)

    def send_stick(self, now):
        """Send as many commands as the link carries: more would queue, and a stop would wait behind them."""
        hz = max(2.0, min(20.0, self.robot.link["drive_hz"]))
        if now < self.sent_at + 1 / hz:
            return
        self.sent_at = now
        self.is_moving = True
        wide = self.robot.is_wide()  # else commands are fewer, so each is valid longer, and QoS 0: none is sent again
        command = {"x": self.stick[0], "z": self.stick[1], "valid_ms": 400 if wide else 750}
        if key := self.robot.key(self.id):
            command |= {"key": key, "t": clock_ms()}  # only with a key is the age of a command judged by t
        self.send("drive-values", command, 1 if wide else 0)


def clock_ms():
    """Return milliseconds of a clock that is never set: by them a robot recognises late commands."""
    return time.monotonic_ns() // 1_000_000


def numbers(text):
    """Return the two numbers in a line; NaN, which releases the stick, if there are none."""
    try:
        x, z = text.split()
        return float(x), float(z)
    except ValueError:
        print("type two numbers, stop or reset", flush=True)
        return math.nan, math.nan
