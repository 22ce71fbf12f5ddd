"""Sends streams of a robot in groups, while an expander beside the remote broker splits them."""

import threading
from collections.abc import Callable
from math import inf

import msgspec
from msgspec.structs import replace

from pebble.contract import OUTGOING, STREAMS, WIRE, codec
from pebble.contract.payloads import Wire
from pebble.extensions.thin.packed import HEARD_S, LAST_DICT, joined, packed
from pebble.runtime.addresses import Addresses
from pebble.services.mqtt_bridge.same_broker import now_ms
from pebble.transports import Message, QoS, Transport
from pebble.transports.counters import Counters

_MOST_STREAMS, _MOST_BYTES = 64, 2048  # in a group, and of each of them; others are sent by themselves
_LEARN_S, _LEARN_AGAIN_S = 3.0, 60.0  # until a group is the dictionary of later ones: by then it has all streams
_CROWDED = 4  # so much longer between two groups, while a queue stands


class StreamGroups:
    """The newest message of each stream, sent together ``group_hz`` times a second. Any thread adds messages.

    A group is deflated with an earlier group as its dictionary, which is published as a retained message.
    """

    def __init__(
        self,
        addresses: Addresses,
        remote: Transport,
        group_hz: float,
        counters: Counters,
        clock: Callable[[], float],
        *,
        named: bool,
    ) -> None:
        self._below = f"{addresses.base}/{OUTGOING}/"
        self._topic, self._wire = addresses[STREAMS].topic, addresses[WIRE].topic
        self._remote, self._counters, self._clock = remote, counters, clock
        self._hz, self._named = group_hz, named
        self._lock = threading.Lock()  # guards the messages that wait
        self._waiting: dict[str, bytes] = {}  # by metric
        self._heard_at = self._sent_at = self._learned_at = -inf
        self._since = inf  # the expander is heard
        self._dict_id, self._dictionary = now_ms() % LAST_DICT + 1, b""
        self._known: frozenset[str] = frozenset()  # metrics in the dictionary
        self._is_announced = False

    def heard(self) -> None:
        """Note that an expander has announced itself."""
        now = self._clock()
        self._since = now if now - self._heard_at > HEARD_S else self._since
        self._heard_at = now

    def takes(self, message: Message) -> bool:
        """Keep a message for the next group, and return True. False: send it by itself."""
        metric, payload = message.topic.removeprefix(self._below), message.payload
        if self._clock() - self._heard_at > HEARD_S or metric == message.topic or len(payload) > _MOST_BYTES:
            return False
        try:
            msgspec.json.decode(payload)
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
            return False
        with self._lock:
            if metric not in self._waiting and len(self._waiting) >= _MOST_STREAMS:
                return False
            if self._waiting.pop(metric, None) is not None:
                self._counters.add("thinned")
            self._waiting[metric] = payload
        return True

    def send(self, takes_room: Callable[[int], bool], *, crowded: bool) -> None:
        """Send the waiting streams, if it is time and there is room. Call this often."""
        now = self._clock()
        if not self._is_announced:
            self._publish_wire()
        if now - self._heard_at > HEARD_S:
            with self._lock:
                self._waiting.clear()
            return
        if not self._waiting or now - self._sent_at < (_CROWDED if crowded else 1) / self._hz - 0.01:
            return
        with self._lock:
            waiting = dict(self._waiting)
        text = joined(waiting)
        raw = packed(text, self._dict_id, self._dictionary)
        if not takes_room(len(raw) + len(self._topic)):
            return
        with self._lock:
            for metric, payload in waiting.items():
                if self._waiting.get(metric) is payload:
                    del self._waiting[metric]
        self._sent_at = now
        self._remote.publish(self._topic, raw, qos=QoS.LATEST)
        self._learn(text, frozenset(waiting), now)

    def _learn(self, text: bytes, metrics: frozenset[str], now: float) -> None:
        """Make a group the dictionary of later groups, if it has streams that the present dictionary lacks."""
        if now - max(self._since, self._learned_at + _LEARN_AGAIN_S - _LEARN_S) < _LEARN_S or metrics <= self._known:
            return
        self._dict_id, self._dictionary = self._dict_id % LAST_DICT + 1, text
        self._known, self._learned_at = metrics, now
        self._publish_wire()

    def _publish_wire(self) -> None:
        wire = Wire(group_hz=self._hz, named=self._named)
        if self._dictionary:
            wire = replace(wire, dict_id=self._dict_id, dict=self._dictionary.decode())
        self._is_announced = True  # without a connection it is sent at the next one
        self._remote.publish(self._wire, codec.encode(WIRE, wire), qos=QoS.DELIVERED, retain=True)
