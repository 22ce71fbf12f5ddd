"""The pipe from the launcher to the announcer, which publishes for it: a socket pair on which neither side waits."""

import logging
import os
import socket

import msgspec

from pebble.launcher.reactor import Reactor
from pebble.runtime.timers import Timer
from pebble.transports import Message

log = logging.getLogger(__name__)

_encode = msgspec.msgpack.Encoder().encode
MESSAGE_LIMIT = 65_536  # bytes; longer ones are dropped
_RETRY_S = 0.1  # until the next attempt, when the socket had no room for a state


class AnnouncerPipe:
    """The launcher's end of the pipe. If the socket is full, records are dropped and counted; states are sent later.

    The kernel's buffer is the bound: some hundred log records that an announcer has not read yet.
    """

    def __init__(self, reactor: Reactor) -> None:
        self.dropped = 0  # records, and messages that are too long
        self._reactor = reactor
        self._retry: Timer | None = None  # for another attempt to send states
        self._states: dict[str, bytes] = {}  # the newest of each topic, as it is sent
        self._unsent: dict[str, bytes] = {}  # states that the present announcer has not received
        self._too_long: set[str] = set()  # topics of messages that were too long
        self._socket: socket.socket | None = None

    def connect(self, will: Message) -> int:
        """Send the will and all states to a new announcer; return its end of the socket, which the caller closes."""
        self.close()
        self._socket, announcers_end = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._socket.setblocking(False)
        self._send(_encode(will))
        self._unsent = dict(self._states)
        self._send_states()
        return announcers_end.detach()

    def state(self, message: Message) -> None:
        """Send a state, which replaces the former one of its topic."""
        raw = _encode(message)
        if self._fits(raw, message.topic):
            self._states[message.topic] = self._unsent[message.topic] = raw
            self._send_states()

    def record(self, message: Message) -> None:
        """Send a message once, after the unsent states; without room it is dropped."""
        raw = _encode(message)
        if self._fits(raw, message.topic) and not (self._send_states() and self._send(raw)):
            self.dropped += 1

    def close(self) -> None:
        """Close the launcher's end, so that the announcer reads the end of the pipe."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _send_states(self) -> bool:
        """Send the unsent states; True if all are sent. Otherwise arrange another attempt."""
        for topic in list(self._unsent):
            if not self._send(self._unsent[topic]):
                if self._socket is not None and self._retry is None:
                    self._retry = self._reactor.after(_RETRY_S, self._retry_now)
                return False
            del self._unsent[topic]
        return True

    def _retry_now(self) -> None:
        self._retry = None
        self._send_states()

    def _fits(self, raw: bytes, topic: str) -> bool:
        """True if a message can be sent; else it is counted, and for each topic logged once."""
        if len(raw) <= MESSAGE_LIMIT:
            return True
        self.dropped += 1
        if topic not in self._too_long:
            self._too_long.add(topic)
            log.error("%s is not published: it has %d bytes, and %d is the most", topic, len(raw), MESSAGE_LIMIT)
        return False

    def _send(self, raw: bytes) -> bool:  # False: no announcer, or no room now
        if self._socket is None:
            return False
        try:
            self._socket.send(raw)
        except BlockingIOError:
            return False
        except OSError:  # the announcer has ended; there will be another
            self.close()
            return False
        return True


def next_message(descriptor: int) -> Message | None:
    """Return the next message from the launcher, first the will; None at the end.

    Raises BlockingIOError, DecodeError.
    """
    raw = os.read(descriptor, MESSAGE_LIMIT)
    return msgspec.msgpack.decode(raw, type=Message) if raw else None
