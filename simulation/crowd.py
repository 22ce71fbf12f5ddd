"""Simulated robots by the thousand, as a broker and an operator see them: ``python -m pebble.simulation.crowd``.

Each has a TCP connection, a client id and a will of its own, and publishes what a board with Wi-Fi does: capabilities,
the state of its emergency stop, four heartbeats a second, every five seconds its battery, and a status as Linux robots
have. It latches stops, and confirms them. It has no firmware, no motors and no dead-man's switch, takes drive commands
without obeying them, and knows no TLS and no names; it is cheap, so that what is measured is not the simulation. For
what a robot does there is :mod:`pebble.simulation.fleet`, with the real firmware.

It is a worker: lines in, JSON lines out. The first answer comes when all are online, or cannot be. ``kill NAME`` breaks
a connection, ``mute NAME`` lets a robot fall silent; both answer with the time (CLOCK_MONOTONIC, ns). ``stops`` answers
with when each robot latched its newest stop.
"""

from __future__ import annotations

import errno
import json
import os
import secrets
import select
import socket
import struct
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, Final

from pebble.contract import (
    CAPABILITIES,
    CHARGING_LEVEL,
    CHARGING_STATUS,
    DRIVE,
    ESTOP,
    ESTOP_RESET,
    ESTOP_STATE,
    ONLINE,
    STATUS,
)
from pebble.contract.identity import Identity
from pebble.motion.latch import Latch
from pebble.transports import Message, QoS
from pebble.transports.mqtt import packets

OWNER: Final = "mcu"
HEARTBEAT_S: Final = 0.25
_REPORT_EVERY = 20  # heartbeats
_KEEPALIVE_S = 10
_CONNECTING = 50  # at a time: a broker's queue of new connections is not long
_ANSWER_S = 10.0  # for the broker to take a connection
_TOGETHER = 10  # heartbeats that are published before sockets are looked at again
_POLL_S = 0.05
_RESET = struct.pack("ii", 1, 0)  # a socket that is closed sends RST
_CONNACK, _PUBLISH, _SUBACK = 2, 3, 9
_LATCH_NAMES = 4


def names(count: int, first: int = 1) -> Iterator[Identity]:
    """crowd-0001, crowd-0002, …"""
    return (Identity("pebble", "robots", f"crowd-{number:04d}") for number in range(first, first + count))


def capabilities(identity: Identity) -> dict[str, Any]:
    """They are what a board's firmware publishes: ``value`` of the payload."""
    none = {"available": False, "controls": False}
    base = identity.base
    return {
        "identity": {"system": identity.system, "type": identity.type, "id": identity.id},
        "transport": {"kind": "mqtt"},
        "drive": {"available": True, "controls": True, "arbitrates": True, "axes": ["x", "z", "y"], "control": False,
                  "topic": DRIVE.topic(base)},
        "estop": {"available": True, "topic": ESTOP.topic(base), "reset_topic": ESTOP_RESET.topic(base),
                  "owners": [OWNER], "status_topics": [ESTOP_STATE.topic(base, owner=OWNER)]},
        "telemetry": {"touch_sensors": False, "charging_status": False,
                      "charging_topic": CHARGING_STATUS.topic(base),
                      "charging_level_topic": CHARGING_LEVEL.topic(base)},
        "lights": {"solid": False, "flash": False},
        **dict.fromkeys(("video", "audio", "soundboard", "autonomy"), none),
        "system": dict.fromkeys(("reboot", "service_restart", "git_pull"), none),
    }  # fmt: skip


class Robot:
    """One of them. ``state`` is "connecting", "asking", "online", "muted" or "dead"."""

    def __init__(self, identity: Identity) -> None:
        self.identity, self.base = identity, identity.base
        self.state = "connecting"
        self.latch = Latch(secrets.token_hex(4), _LATCH_NAMES, lambda a, b: a - b)
        self.stopped_ns = 0
        self.drives = 0  # commands
        self._since = time.monotonic()
        self._heartbeats = 0
        self._rest = b""
        self.sock = socket.socket()
        self.sock.setblocking(False)
        self.sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    @property
    def late(self) -> bool:
        """Whether the broker takes too long to answer."""
        return self.state in ("connecting", "asking") and time.monotonic() - self._since > _ANSWER_S

    def connect(self, broker: tuple[str, int]) -> None:
        if (code := self.sock.connect_ex(broker)) not in (0, errno.EINPROGRESS):
            raise OSError(code, os.strerror(code))

    def begin(self) -> None:
        """It is connected: ask the broker in."""
        if code := self.sock.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR):
            raise OSError(code, os.strerror(code))
        self.state = "asking"
        will = Message(ONLINE.topic(self.base), b'{"t": 0, "online": false}', QoS.DELIVERED, retain=True)
        name = f"{self.identity.id}-{secrets.token_hex(2)}"
        self._send(
            packets.connect(
                name, modern=False, bridge=False, keepalive_s=_KEEPALIVE_S, will=will, username=None, password=None
            )
        )
        wanted = [packets.Filter(one.topic(self.base), 1) for one in (ESTOP, DRIVE, ESTOP_RESET)]
        self._send(packets.subscribe(1, wanted, modern=False))

    def heartbeat(self) -> None:
        """Publish what is due with this heartbeat."""
        if self.state != "online":
            return
        self._publish(ONLINE.topic(self.base), b'{"t": %d, "online": true}' % _epoch_ms())
        self._heartbeats += 1
        if self._heartbeats % _REPORT_EVERY == 1:
            volts = 7.6 + 0.4 * (hash(self.base) % 100) / 100
            self._publish(CHARGING_LEVEL.topic(self.base), b'{"value": %.3f, "unit": "v"}' % volts)
            services = {"mcu": {"state": "ready"}, "mqtt_bridge": {"state": "ready"}}
            self._publish(STATUS.topic(self.base), json.dumps({"value": {"services": services}}).encode())

    def read(self) -> bool:
        """Take what has arrived; whether it went online with it. Raises OSError for an end of the connection."""
        data = self.sock.recv(65536)
        if not data:
            raise ConnectionError("the broker has closed the connection")
        data, came = self._rest + data, False
        while (end := _packet_end(data)) is not None:
            head, size = end
            came = self._take(data[0], data[head : head + size]) or came
            data = data[head + size :]
        self._rest = data
        return came

    def end(self, *, abruptly: bool) -> None:
        self.state = "dead"
        if abruptly:
            self.sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _RESET)
        self.sock.close()

    def _take(self, first: int, body: bytes) -> bool:
        kind = first >> 4
        if kind == _CONNACK and body[1]:
            raise ConnectionError(f"the broker refuses the connection ({body[1]})")
        if kind == _SUBACK:
            self.state = "online"
            payload = {"schema": "pebble-capabilities/v1", "t": _epoch_ms(), "value": capabilities(self.identity)}
            self._publish(CAPABILITIES.topic(self.base), json.dumps(payload).encode())
            self._publish_stop()
            self.heartbeat()
            return True
        if kind == _PUBLISH:
            length = int.from_bytes(body[:2], "big")
            topic, rest = body[2 : 2 + length].decode(), body[2 + length :]
            if first & 0b110:
                self._send(b"\x40\x02" + rest[:2])
                rest = rest[2:]
            if not first & packets.RETAIN:
                self._obey(topic.rpartition("/")[2], rest)
        return False

    def _obey(self, metric: str, payload: bytes) -> None:
        if metric == DRIVE.metric:
            self.drives += 1
            return
        order = json.loads(payload)
        if metric == ESTOP.metric:
            if self.latch.stop(order["stop"], order.get("by", ""), order.get("why", ""), _epoch_ms()):
                self.stopped_ns = time.monotonic_ns()
                self._publish_stop()
        elif self.latch.reset(order.get("boot"), order.get("count"), 0, _now_ms()):
            self._publish_stop()

    def _publish_stop(self) -> None:
        state = {"t": _epoch_ms(), **self.latch.state(True)}
        self._publish(ESTOP_STATE.topic(self.base, owner=OWNER), json.dumps(state).encode())

    def _publish(self, topic: str, payload: bytes) -> None:
        self._send(packets.publish(topic, payload, 0, 0, retain=True, modern=False, expires_s=None))

    def _send(self, data: bytes) -> None:
        """A broker that does not read for so long that nothing fits any more is as good as lost."""
        if self.sock.send(data) != len(data):
            raise ConnectionError("the broker does not read")


def _packet_end(data: bytes) -> tuple[int, int] | None:
    """Length of the first packet's head and of what follows it; None: it is not all here."""
    size = 0
    for at in range(1, min(5, len(data))):
        size |= (data[at] & 127) << 7 * (at - 1)
        if data[at] < 128:
            return (at + 1, size) if len(data) >= at + 1 + size else None
    return None


def _epoch_ms() -> int:
    return int(1000 * time.time())


def _now_ms() -> int:
    return time.monotonic_ns() // 1_000_000


class Crowd:
    """All robots of one process, on one thread. Commands are those of the module's docstring."""

    def __init__(self, identities: list[Identity], broker: tuple[str, int]) -> None:
        self.robots: dict[str, Robot] = {}
        self.problems: dict[str, str] = {}  # by robot, why it is not online
        self._waiting = identities[::-1]
        self._count = len(identities)
        self._broker = broker
        self._epoll = select.epoll()
        self._of: dict[int, Robot] = {}
        self._began = time.monotonic()
        self._answered = False
        self._order: list[Robot] = []
        self._place, self._heartbeats_at = 0, time.monotonic()

    @property
    def online(self) -> int:
        return sum(robot.state in ("online", "muted") for robot in self.robots.values())

    def run(self, handle: Callable[[bytes], bool]) -> None:
        """Until ``handle``, which gets what arrives on standard input, returns False."""
        self._epoll.register(0, select.EPOLLIN)
        going = True
        while going:
            self._connect_some()
            for descriptor, _ in self._epoll.poll(self._pause_s()):
                if descriptor == 0:
                    going = handle(os.read(0, 65536))
                elif (robot := self._of.get(descriptor)) is not None:
                    self._guarded(robot, partial(self._serve, robot))
            self._publish_heartbeats()
            self._answer()

    def _pause_s(self) -> float:
        if not self._order:
            return _POLL_S
        return min(_POLL_S, max(0.0, self._heartbeats_at - time.monotonic()))

    def _connect_some(self) -> None:
        busy = sum(robot.state in ("connecting", "asking") for robot in self.robots.values()) if self._waiting else 0
        while self._waiting and busy < _CONNECTING:
            identity = self._waiting.pop()
            try:
                robot = self.robots[identity.id] = Robot(identity)
            except OSError as error:
                self.problems[identity.id] = f"{error.strerror}: this process needs a file for each robot"
                continue
            busy += 1
            self._of[robot.sock.fileno()] = robot
            self._guarded(robot, partial(robot.connect, self._broker))
            if robot.state != "dead":
                self._epoll.register(robot.sock, select.EPOLLOUT)
        if not self._answered:
            for robot in list(self.robots.values()):
                if robot.late:
                    self._guarded(robot, _not_answered)

    def _serve(self, robot: Robot) -> None:
        if robot.state == "connecting":
            robot.begin()
            self._epoll.modify(robot.sock, select.EPOLLIN)
        elif robot.read():
            self._order.append(robot)

    def _guarded(self, robot: Robot, work: Callable[[], object]) -> None:
        """A robot whose connection ends is dead, with its reason; the others go on."""
        try:
            work()
        except OSError as error:
            self.problems[robot.identity.id] = error.strerror or str(error)
            self._end(robot, abruptly=False)

    def _end(self, robot: Robot, *, abruptly: bool) -> None:
        self._of.pop(robot.sock.fileno(), None)
        robot.end(abruptly=abruptly)

    def _publish_heartbeats(self) -> None:
        """Heartbeats of all robots are evenly spread; those that are overdue are not published twice."""
        now = time.monotonic()
        if not self._order or now < self._heartbeats_at:
            return
        step = HEARTBEAT_S / len(self._order)
        due = 1 + int((now - self._heartbeats_at) / step)
        for _ in range(min(due, _TOGETHER, len(self._order))):
            self._place = (self._place + 1) % len(self._order)
            robot = self._order[self._place]
            self._guarded(robot, robot.heartbeat)
            self._heartbeats_at += step
        self._heartbeats_at = max(self._heartbeats_at, now - HEARTBEAT_S)

    def _answer(self) -> None:
        if self._answered or self.online + len(self.problems) < self._count:
            return
        self._answered = True
        problem = next(iter(self.problems.values()), "")
        answer({"online": self.online, "took_s": time.monotonic() - self._began, "problem": problem})

    # -- commands

    def obey(self, line: str) -> None:
        what, _, name = line.partition(" ")
        if what == "kill":
            now = time.monotonic_ns()
            self._end(self.robots[name], abruptly=True)
            answer({"ns": now})
        elif what == "mute":
            self.robots[name].state = "muted"
            answer({"ns": time.monotonic_ns()})
        elif what == "stops":
            answer({name: robot.stopped_ns for name, robot in self.robots.items()})


def answer(what: dict[str, Any]) -> None:
    sys.stdout.write(json.dumps(what) + "\n")
    sys.stdout.flush()


def _not_answered() -> None:
    raise TimeoutError(errno.ETIMEDOUT, f"the broker did not take the connection within {_ANSWER_S:.0f} s")


def main(arguments: list[str]) -> None:
    """Arguments: the broker's port on loopback, how many robots, and the number of the first one (1)."""
    port, count, *first = map(int, arguments)
    crowd, rest = Crowd(list(names(count, *first)), ("127.0.0.1", port)), b""

    def handle(data: bytes) -> bool:
        nonlocal rest
        *lines, rest = (rest + data).split(b"\n")
        for line in lines:
            crowd.obey(line.decode())
        return bool(data)

    crowd.run(handle)


if __name__ == "__main__":
    main(sys.argv[1:])
