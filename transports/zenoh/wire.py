"""The protocol between a robot's Zenoh sessions, apart from payloads: keys, stamps and queries to the hub.

A live message carries its QoS, whether it was published with retain, and when it was sent. A retained message is
sent under ``@retain/`` with the name of the session that wrote it, and how many such messages it had sent by then.
``@`` chunks match no wildcard, so no ordinary subscription receives these.
"""

from __future__ import annotations

import contextlib
import queue
import struct
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any
from zlib import crc32

import msgspec
import zenoh

from pebble.transports.base import Message, QoS
from pebble.transports.zenoh.callbacks import direct

RETAINED = "@retain/"  # + key: the newest retained message, put before the live one and queried by subscribers
SYNC = "@sync/"  # + name: answers with how many retained messages this session has sent, in 8 bytes
UP = "@up/"  # + name: liveliness token of a hub
LIVE = "@live/"  # + name: liveliness token of a client
HELLO = "@hub/hello"  # query: name, digests of retained messages, will; the answer lists the keys the hub lacks
BYE = "@hub/bye"  # query: remove my will, I have published it myself
# Clients from other machines that have an account say hello and goodbye under it: @hub/hello/<account>. Their sessions
# are named <account>~…
OF = "~"
ALL_KEYS = ("**", *(f"{prefix}**" for prefix in (RETAINED, SYNC, UP, LIVE, "@hub/")))

RETAINED_ANSWER_S = 3.0  # so long a client waits for what is retained
_LATE_S = 0.1  # so much later than its time limit Zenoh may say that a query has ended

# How put() and get() treat a message. Not `express`: it is no faster here (64 B at 200 Hz: p50 108 against 112 us), and
# it gives each message a batch of its own, so that 1.5 s of 200 Hz fill the queue to a stopped sibling.
_Treatment = dict[str, Any]
_DATA: _Treatment = {"priority": zenoh.Priority.DATA}
_FIRST: _Treatment = {"priority": zenoh.Priority.REAL_TIME}
_WAIT: _Treatment = {"congestion_control": zenoh.CongestionControl.BLOCK}
_DROP: _Treatment = {"congestion_control": zenoh.CongestionControl.DROP}
BLOCK = {**_DATA, **_WAIT}
TREATMENTS = {  # by QoS and urgency
    (QoS.DELIVERED, False): BLOCK,
    (QoS.DELIVERED, True): {**_FIRST, **_WAIT},
    (QoS.LATEST, False): {**_DATA, **_DROP},
    (QoS.LATEST, True): {**_FIRST, **_DROP},
}

_QUALITIES = (QoS.LATEST, QoS.DELIVERED)

_LIVE = struct.Struct(">BIQ")  # QoS and retain, boot, ns since it
_RETAINED = struct.Struct(">BQ")

BOOT = crc32(Path("/proc/sys/kernel/random/boot_id").read_bytes())  # shared by all containers of a machine


#: A clock that all processes of a machine share; it runs on while the machine sleeps, and cannot be set.
since_boot_ns: Callable[[], int] = partial(time.clock_gettime_ns, time.CLOCK_BOOTTIME)


class LiveStamp(msgspec.Struct, frozen=True):
    """The attachment of a live message; ``sent_ns`` counts since ``boot``. Both are 0 if it has no attachment."""

    qos: QoS
    retain_requested: bool | None
    boot: int
    sent_ns: int


def pack_live(qos: QoS, *, retain_requested: bool) -> bytes:
    return _LIVE.pack(qos | retain_requested << 1, BOOT, since_boot_ns())


def read_live(attachment: zenoh.ZBytes | None) -> LiveStamp:
    """Return the stamp of a live message; an empty one for messages of other programs."""
    data = b"" if attachment is None else attachment.to_bytes()
    if len(data) != _LIVE.size:
        return LiveStamp(QoS.LATEST, None, 0, 0)
    flags, boot, sent_ns = _LIVE.unpack(data)
    return LiveStamp(_QUALITIES[flags & 1], bool(flags & 2), boot, sent_ns)


class Stamp(msgspec.Struct, frozen=True):
    """The origin of a retained message. ``retained_count`` 0: it was sent again, or the hub made it.

    The fields are not checked, because a hub is not told from which session a message has come. So a client that may
    retain on a topic can forge them: a session then skips that message as its own, or a query is answered 0.5 s early.
    """

    qos: QoS
    retained_count: int
    origin: str

    def pack(self) -> bytes:
        return _RETAINED.pack(self.qos, self.retained_count) + self.origin.encode()

    @classmethod
    def unpack(cls, data: bytes) -> Stamp:
        """Return the stamp in ``data``. Raises ValueError for anything that ``pack`` did not make."""
        try:
            qos, retained_count = _RETAINED.unpack_from(data)
        except struct.error as error:
            raise ValueError(str(error)) from None
        return cls(QoS(qos), retained_count, data[_RETAINED.size :].decode())


class Will(msgspec.Struct, frozen=True, array_like=True):
    """The will of a client. Its id ``client`` stays the same after a restart, unlike the name of its session."""

    topic: str
    payload: bytes
    qos: QoS
    retain: bool
    client: str = ""

    @classmethod
    def of(cls, message: Message, client: str) -> Will:
        return cls(message.topic, message.payload, message.qos, message.retain, client)


class Hello(msgspec.Struct, frozen=True, array_like=True):
    """The first message of a client. ``own`` has a digest for each key that it retains, None for a removed key.

    A field may be added at the end: msgspec skips unknown ones.
    """

    name: str
    retained_count: int
    will: Will | None
    own: dict[str, int | None]


digest = crc32
encode = msgspec.msgpack.encode
decode_hello = msgspec.msgpack.Decoder(Hello).decode
decode_name = msgspec.msgpack.Decoder(str).decode
decode_keys = msgspec.msgpack.Decoder(list[str]).decode
decode_counts = msgspec.msgpack.Decoder(dict[str, int]).decode


def asked(what: str, account: str) -> str:
    """Return the key of a query to the hub, from an account or from a process of this machine."""
    return f"{what}/{account}" if account else what


def ask(session: zenoh.Session, key: str, payload: bytes, timeout: float) -> bytes | None:
    """Send a query to the hub, and return its answer; None if none comes within ``timeout`` seconds.

    It returns with the first answer: where a hub has just died, the query ends long after the next hub has answered.
    """
    replies: queue.SimpleQueue[zenoh.Reply | None] = queue.SimpleQueue()  # None: the query has ended
    session.get(
        key,
        direct(replies.put, lambda: replies.put(None)),
        target=zenoh.QueryTarget.ALL,
        consolidation=zenoh.ConsolidationMode.NONE,
        timeout=timeout,
        payload=payload,
        **BLOCK,
    )
    end = time.monotonic() + timeout + _LATE_S
    with contextlib.suppress(queue.Empty):
        while (reply := replies.get(timeout=max(0.0, end - time.monotonic()))) is not None:
            if reply.ok is not None:
                return reply.ok.payload.to_bytes()
    return None


def account_of(key: str, what: str) -> str:
    """Return the account in a key of :func:`asked`; "" for a process of this machine. Raises ValueError."""
    account = key.removeprefix(what).removeprefix("/")
    if not key.startswith(what) or "*" in account or "/" in account or OF in account:
        raise ValueError(f"{key} is no query of an account")
    return account
