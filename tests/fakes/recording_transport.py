"""A transport that writes its messages to a file, for tests of another process."""

from __future__ import annotations

import json
import threading
from pathlib import Path

from pebble.transports import Message, State, Transport
from pebble.transports.base import Subscription


class RecordingTransport(Transport):
    """A transport that appends a JSON line per message to ``file``. It is connected once open, unless ``hangs``."""

    def __init__(self, client_id: str, file: Path, *, will: Message | None = None, hangs: bool = False) -> None:
        super().__init__(client_id, will=will)
        self._file, self._hangs = file, hangs

    def _open(self, timeout: float) -> None:
        if self._hangs:
            threading.Event().wait()
        self._set_state(State.CONNECTED)

    def _close(self, will: Message | None) -> None:
        if will is not None:
            self._write(will, "will")

    def _send(self, message: Message, urgent: bool) -> bool:
        if self.state is not State.CONNECTED:
            return False
        self._write(message, "message")
        return True

    def _write(self, message: Message, what: str) -> None:
        line = {
            "what": what,
            "topic": message.topic,
            "payload": json.loads(message.payload),
            "qos": int(message.qos),
            "retain": message.retain,
        }
        with self._file.open("a") as out:
            out.write(json.dumps(line) + "\n")

    def _declare(self, subscription: Subscription) -> None: ...

    def _undeclare(self, subscription: Subscription) -> None: ...
