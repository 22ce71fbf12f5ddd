"""Two programs that communicate over an impaired network, for tests."""

import sys
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from pebble.extensions.lab.bench.impair.network import REMOTE_HOST, NamespaceNetwork
from pebble.extensions.lab.rig.processes import Worker, end_all

_ANSWER_S = 40.0
_PEER = [sys.executable, "-I", str(Path(__file__).with_name("peer.py"))]


class ProbeConnection:
    """One connection from the robot's side to the broker's."""

    def __init__(self, network: NamespaceNetwork, logs: Path) -> None:
        self._server = Worker("server", network.on_remote([*_PEER, "serve", REMOTE_HOST]), logs / "server.log")
        self._workers = [self._server]
        try:
            printed = self._server.answer(_ANSWER_S)
            command = [*_PEER, "talk", REMOTE_HOST, str(printed["tcp"]), str(printed["udp"])]
            self._client = Worker("client", network.on_robot(command), logs / "client.log")
            self._workers.append(self._client)
            self._client.answer(_ANSWER_S)
        except BaseException:
            self.end()
            raise

    def up(self, size: int) -> float:
        """Seconds until so many bytes have been received and acknowledged by the other side."""
        return float(self._ask(f"up {size}"))

    def down(self, size: int) -> float:
        """Seconds until so many bytes have arrived from the broker's side."""
        return float(self._ask(f"down {size}"))

    def send_datagrams(self, n: int) -> None:
        self._ask(f"datagrams {n}")

    def received_datagrams(self) -> int:
        self._server.send("received")
        return int(self._server.answer(_ANSWER_S)["received"])

    def end(self) -> None:
        end_all(self._workers)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self.end()

    def _ask(self, line: str) -> Any:
        self._client.send(line)
        return self._client.answer(_ANSWER_S)["result"]
