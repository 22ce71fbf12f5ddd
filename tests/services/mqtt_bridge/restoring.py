"""A robot's own side that is restored from an older save, and who switched a microphone on and off before."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from pebble.transports import ZenohSettings
from tests.support import Broker
from tests.transports.zenoh_net import HubProcess

TRUE, FALSE = b'{"value": true}', b'{"value": false}'


class OwnBroker:
    """The robot's own side over MQTT; ``save`` and ``restore`` as a backup of its files does."""

    def __init__(self, folder: Path) -> None:
        self._broker = Broker(folder, persistence=True)
        self.port = self._broker.port
        self.address: dict[str, Any] | ZenohSettings = {"host": "127.0.0.1", "port": self.port}
        self._saved: dict[Path, bytes] = {}

    def save(self) -> None:
        self._broker.save()
        self._saved = {file: file.read_bytes() for file in self._broker.store.iterdir()}

    def stop(self) -> None:
        self._broker.kill()

    def restore(self) -> None:
        for file, data in self._saved.items():
            file.write_bytes(data)
        self._broker.start()


class OwnHub:
    """The same over Zenoh: a hub with a journal."""

    def __init__(self, folder: Path) -> None:
        self._journal = folder / "journal"
        self._hub = HubProcess(folder / "run", self._journal).start()
        self.address = self._hub.settings

    def save(self) -> None:
        self._hub.wait_until_stored()
        self._saved = self._journal.read_bytes()

    def stop(self) -> None:
        self._hub.kill()

    def restore(self) -> None:
        self._journal.write_bytes(self._saved)
        self._hub.start()


#: Who sets the microphone, in order: an operator, a program on the robot that lives on, and one that is not asked to
#: repeat what it set. Each history ends with the microphone switched off, after the save.
HISTORIES = [
    *("operator:on save operator:off", "program:on save program:off", "once:on save once:off"),
    *("operator:on save program:off", "operator:on save once:off", "program:on save operator:off"),
    *("once:on save operator:off", "program:on operator:off program:on save operator:off"),
    *("save operator:on operator:off", "save program:on operator:off", "save operator:on once:off"),
    *("operator:off operator:on save operator:off", "program:off once:on save program:off"),
]


def play(history: str, set_microphone: Callable[[str, bytes], None], save: Callable[[], None]) -> None:
    for word in history.split():
        who, _, value = word.partition(":")
        if value:
            set_microphone(who, TRUE if value == "on" else FALSE)
        else:
            save()
