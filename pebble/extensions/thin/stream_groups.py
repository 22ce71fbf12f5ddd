"""Sends streams of a robot in groups, while an expander beside the remote broker splits them."""

import logging
import threading
from collections.abc import Callable
from contextlib import suppress
from math import inf

import msgspec
from msgspec import UNSET
from msgspec.structs import replace

from pebble.config import Config
from pebble.contract import EXPANDER, OUTGOING, STREAMS, WIRE, channel_of, codec
from pebble.contract.channels import SHORT
from pebble.contract.payloads import Wire
from pebble.errors import PayloadError
from pebble.extensions.thin.packed import HEARD_S, LAST_DICT, joined, packed
from pebble.runtime.addresses import Addresses
from pebble.services.mqtt_bridge.same_broker import now_ms
from pebble.transports import Message, QoS, Transport
from pebble.transports.counters import Counters

_MOST_STREAMS, _MOST_BYTES = 64, 2048  # in a group, and of each of them; others are sent by themselves
_LEARN_S, _LEARN_AGAIN_S = 3.0, 60.0  # until a group is the dictionary of later ones: by then it has all streams
_CROWDED = 4  # so much longer between two groups, while a queue stands
_EARLY_S = 0.01  # a call that comes so much too early sends a group, too: the next one is POLL_S later
_TRIES = 5  # of a short name that no expander hears
log = logging.getLogger(__name__)


class StreamGroups:
    """The newest message of each stream, sent together ``group_hz`` times a second. Any thread adds messages.

    Groups are compressed with an earlier group as the dictionary, which is published retained. They may have a short
    topic (``short`` in the config), only while an expander announces that it hears groups there: a broker may refuse
    the topic, and another robot may use it.
    """

    def __init__(
        self,
        config: Config,
        addresses: Addresses,
        remote: Transport,
        counters: Counters,
        clock: Callable[[], float],
    ) -> None:
        link = config.services.mqtt_bridge.link
        self._below = f"{addresses.base}/{OUTGOING}/"
        self._topic, self._wire = addresses[STREAMS].topic, addresses[WIRE].topic
        self._short = f"{SHORT}{link.short}" if link.short else ""
        self._short_is_heard = False  # by an expander
        self._tries = 0  # empty groups sent to the short topic, so that an expander hears it
        self._remote, self._counters, self._clock = remote, counters, clock
        self._hz, self._named = link.group_hz, config.security.named  # the latter is only told to expanders
        self._contract_only = config.security.level != "open"  # brokers let an expander publish no others
        self._lock = threading.Lock()  # guards the messages that wait
        self._waiting: dict[str, bytes] = {}  # by metric
        self._heard_at = self._sent_at = -inf  # when an expander was heard, and when a group was sent
        self._learned_at = -inf  # when a group became the dictionary
        self._heard_since = inf  # since when an expander is heard
        self._dict_id, self._dictionary = now_ms() % LAST_DICT + 1, b""  # probably not the number before a restart
        self._dictionary_metrics: frozenset[str] = frozenset()  # of the streams in that group
        self._is_announced = False

    def heard(self, raw: bytes) -> None:
        """Note an expander's announcement. If it lacks our short topic, send an empty group there to be heard."""
        now = self._clock()
        if now - self._heard_at > HEARD_S:
            self._heard_since, self._tries = now, 0
        self._heard_at = now
        with suppress(PayloadError, AttributeError):
            self._short_is_heard = codec.plain(EXPANDER, raw).get("short") == self._short
        if not self._short:
            return
        self._tries = 0 if self._short_is_heard else self._tries + 1
        if 1 <= self._tries <= _TRIES:  # an empty group: an expander that hears it will announce so
            self._remote.publish(self._short, b"{}", qos=QoS.LATEST)
        elif self._tries == _TRIES + 1:
            log.warning("no expander hears %s: the broker refuses it, or another robot has it", self._short)

    def takes(self, message: Message) -> bool:
        """Keep a message for the next group, and return True. False: send it by itself."""
        metric, payload = message.topic.removeprefix(self._below), message.payload
        if self._contract_only and channel_of(f"{OUTGOING}/{metric}") is None:
            return False
        is_heard = self._clock() - self._heard_at <= HEARD_S
        is_outgoing = metric != message.topic  # it was below outgoing/
        if not is_heard or not is_outgoing or len(payload) > _MOST_BYTES:
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
        if now - self._heard_at > HEARD_S:  # no expander would split them
            with self._lock:
                self._waiting.clear()
            return
        period_s = (_CROWDED if crowded else 1) / self._hz
        if not self._waiting or now - self._sent_at < period_s - _EARLY_S:
            return
        with self._lock:
            waiting = dict(self._waiting)
        text = joined(waiting)
        raw = packed(text, self._dict_id, self._dictionary)
        topic = self._short if self._short and self._short_is_heard else self._topic
        if not takes_room(len(raw) + len(topic)):
            return
        with self._lock:
            for metric, payload in waiting.items():
                if self._waiting.get(metric) is payload:  # no newer message has replaced it meanwhile
                    del self._waiting[metric]
        self._sent_at = now
        self._remote.publish(topic, raw, qos=QoS.LATEST)
        self._learn(text, frozenset(waiting), now)

    def _learn(self, text: bytes, metrics: frozenset[str], now: float) -> None:
        """Make a group the dictionary of later groups, if it has streams that the present dictionary lacks."""
        due = max(self._heard_since + _LEARN_S, self._learned_at + _LEARN_AGAIN_S)
        if now < due or metrics <= self._dictionary_metrics:
            return
        self._dict_id, self._dictionary = self._dict_id % LAST_DICT + 1, text
        self._dictionary_metrics, self._learned_at = metrics, now
        self._publish_wire()

    def _publish_wire(self) -> None:
        wire = Wire(group_hz=self._hz, named=self._named, short=self._short or UNSET)
        if self._dictionary:
            wire = replace(wire, dict_id=self._dict_id, dict=self._dictionary.decode())
        self._is_announced = True  # without a connection it is sent at the next one
        self._remote.publish(self._wire, codec.encode(WIRE, wire), qos=QoS.DELIVERED, retain=True)
