"""The neighbours of a robot that runs no program of ours, such as a board; this program runs beside its broker."""

import os
import zlib
from pathlib import Path
from typing import Any

from msgspec.structs import replace

from pebble.config import Config, Mqtt, parse
from pebble.contract import ONLINE
from pebble.contract.levels import silent_after
from pebble.contract.payloads import Heartbeat
from pebble.runtime.connections import local_transport
from pebble.runtime.service import every
from pebble.services.neighbours.config import Neighbours
from pebble.services.neighbours.service import HEARTBEAT_S, NeighboursService
from pebble.transports import Message

AWAY_S = silent_after(0.5)  # boards publish four heartbeats a second


class BoardNeighbours(NeighboursService):
    """The service of a board for its neighbours. It announces the board only while the board's heartbeats arrive.

    It runs on another machine, and may outlive the board.
    """

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._received_live_at = float("-inf")

    def set_up(self) -> None:
        super().set_up()
        self.transport.subscribe(
            self.addresses[ONLINE].topic, self.refusals.reader(ONLINE, self._on_heartbeat), direct=True
        )

    def _on_heartbeat(self, message: Message, heartbeat: Heartbeat, _names: dict[str, str]) -> None:
        """Handle a heartbeat of the board, on the transport's thread."""
        if not message.retain:
            self._received_live_at = float("-inf") if heartbeat.online is False else self.clock()

    @every(HEARTBEAT_S)
    def _announce(self) -> None:
        if self.clock() - self._received_live_at <= AWAY_S:
            super()._announce()


def of_board(base: str, section: Neighbours, broker: Mqtt, run_dir: Path) -> BoardNeighbours:
    """Make the neighbours of the robot ``base`` at ``broker``; they do not run yet."""
    system, kind, name = base.split("/")
    folder = run_dir / f"{zlib.crc32(base.encode()):08x}"  # short, because of sockets in it
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    raw = {"robot": {"system": system, "type": kind, "id": name}, "transport": {"kind": "mqtt", "run_dir": str(folder)}}
    plain: Config = parse(raw, folder=run_dir, env=os.environ)
    config = replace(plain, local_mqtt=broker, services=replace(plain.services, neighbours=section))
    return BoardNeighbours(config, local_transport(config, BoardNeighbours.name))
