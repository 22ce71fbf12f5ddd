"""A minute of a robot on Wi-Fi: joining, commands at 20 Hz, a flood, bad ones, stops, outages, reconnects."""

import json

import board
import net

_MINUTE_MS = 60_000
_COMMAND_MS = 50
_TOPIC = b"pebble/robots/%s/incoming/%s%s"
_BAD = (
    b'{"x": NaN, "z": 1}',
    b"{" * 1000,
    b'{"value": [1, 2]}',
    b"\xff\xfe\x00",
    b'{"x": 1e999, "z": "' + b"9" * 900 + b'"}',
    b"x" * 3000,
)


class Workload:
    def __init__(self, case):
        robot, by = case["robot"].encode(), case["by"].encode()
        topic = _TOPIC % (robot, by, b"drive-values")
        self._estop = _TOPIC % (robot, by, b"estop")
        self._reset = _TOPIC % (robot, by, b"estop-reset")
        self._stops = self._resets = 0
        self._signed = net.publish(
            topic, b'{"x":-0.250,"z":0.625,"y":0.000,"source":"autonomy","run":1000000,"valid_ms":400}', 2
        )
        self._drive = net.publish(topic, b'{"x": -0.250, "y": 0.000, "z": 1.000}', 2)
        self._wrapped = net.publish(topic, b'{"t": 1700000000000, "value": {"x": "0.5", "z": 0.75, "y": 0}}', 2)
        self._retained = net.publish(topic, b'{"x": 0, "z": 1}', 3)
        self._bad = [net.publish(topic, payload, 2) for payload in _BAD]
        self._next = 0
        self._count = 0
        self._part = "booting"

    def between(self, robot):
        board.now += 10
        if board.now > _MINUTE_MS:
            return ""
        second = board.now // 1000
        net.wifi_up = board.now > 2000 and not 40 <= second < 44
        net.broker_up = not 25 <= second < 30
        net.serve()
        if not net.wifi_up or not net.broker_up:
            return "no network"
        if board.now < self._next:
            return self._part
        self._next = board.now + _COMMAND_MS
        self._count += 1
        if not net.connection or board.to_board.used:
            return self._part
        if 15 <= second < 20:
            self._part = "flood"
            for _ in range(25):  # 500 a second
                board.to_board.put(self._drive)
        elif 20 <= second < 24:
            self._part = "bad commands"
            board.to_board.put(self._bad[self._count % len(self._bad)])
            board.to_board.put(self._retained)
        elif 32 <= second < 38:
            self._part = "stops"
            self._stop_or_reset(second)
        elif 46 <= second < 52:
            self._part = "a script"
            board.to_board.put(self._signed)
        else:
            self._part = "driving"
            board.to_board.put(self._wrapped if self._count & 1 else self._drive)
        return self._part

    def _stop_or_reset(self, second):
        """Twice a second some stops with long texts, or too long to be stored, then resets."""
        if self._count % 10 < 5 and second < 37:
            self._stops += 1
            text = b'{"stop":"%016x","by":"%s","why":"%s"}' % (self._stops, b"b" * 32, b"w" * 40)
            board.to_board.put(net.publish(self._estop, text if self._stops % 9 else b"x" * 2000, 2))
        elif b'"latched":true' in bytes(net.state):
            state = json.loads(net.state)
            self._resets += 1
            text = b'{"boot":"%s","count":%d,"by":"ann"}' % (state["boot"].encode(), state["count"])
            board.to_board.put(net.publish(self._reset, text, 2))

    def check(self, robot):
        assert self._stops > 10, self._stops
        assert self._resets > 5, self._resets
        state = json.loads(net.state)
        assert state["count"] > 10, state
        assert not state["latched"], state
        assert state["persisted"] is True, state
        assert net.counts.get(net.CONNECT, 0) >= 3, net.counts  # boot, after the broker's outage, after the Wi-Fi's
        assert net.counts.get(net.SUBSCRIBE, 0) >= 3, net.counts
        assert net.counts.get(net.PUBLISH, 0) > 100, net.counts  # heartbeats
