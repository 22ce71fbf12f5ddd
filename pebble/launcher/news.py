"""What the launcher tells its announcer: whole messages over a socket pair, and nobody ever waits."""

from __future__ import annotations

import os
import socket
from typing import Literal

import msgspec

from pebble.launcher.reactor import Reactor
from pebble.timers import Timer
from pebble.transports import Message

WORD_LIMIT = 65_536  # bytes; longer words are dropped
_RETRY_S = 0.1  # a listener who had no room for a state has that long to make some

What = Literal["will", "state", "record"]


class Word(msgspec.Struct, frozen=True, array_like=True):
    """The will comes first; a state is to be said again on every new connection, a record only now."""

    what: What
    message: Message


class News:
    """The launcher's end. What the socket has no room for is dropped and counted; a state is told when there is room.

    The bound is the kernel's buffer: some hundred log records that an announcer has not read yet.
    """

    def __init__(self, reactor: Reactor) -> None:
        self.dropped = 0  # records
        self._reactor = reactor
        self._retry: Timer | None = None
        self._states: dict[str, Message] = {}
        self._owed: dict[str, Message] = {}  # states that the present listener was not told yet
        self._socket: socket.socket | None = None

    def connect(self, will: Message) -> int:
        """Tell a new listener everything from the start; returns its end of the socket, which the caller closes."""
        self.close()
        self._socket, other = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._socket.setblocking(False)
        self._say("will", will)
        self._owed = dict(self._states)
        self._catch_up()
        return other.detach()

    def state(self, message: Message) -> None:
        """The newest value of its topic."""
        self._states[message.topic] = self._owed[message.topic] = message
        self._catch_up()

    def record(self, message: Message) -> None:
        """Something of the moment. States go first."""
        if not (self._catch_up() and self._say("record", message)):
            self.dropped += 1

    def close(self) -> None:
        """The listener hears that there is nothing more to come."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _catch_up(self) -> bool:
        """Tell the states that are owed; False, and another try later, if there is no room."""
        for topic in list(self._owed):
            if not self._say("state", self._owed[topic]):
                self._try_later()
                return False
            del self._owed[topic]
        return True

    def _try_later(self) -> None:
        if self._socket is not None and self._retry is None:
            self._retry = self._reactor.after(_RETRY_S, self._try_again)

    def _try_again(self) -> None:
        self._retry = None
        self._catch_up()

    def _say(self, what: What, message: Message) -> bool:
        word = msgspec.msgpack.encode(Word(what, message))
        if self._socket is None or len(word) > WORD_LIMIT:
            return False
        try:
            self._socket.send(word)
        except BlockingIOError:
            return False
        except OSError:  # the listener has ended; there will be another
            self.close()
            return False
        return True


def next_word(descriptor: int) -> Word | None:
    """The listener's end: the next word, None when no more will come. Raises BlockingIOError, DecodeError."""
    raw = os.read(descriptor, WORD_LIMIT)
    return msgspec.msgpack.decode(raw, type=Word) if raw else None
