"""Two programs that talk over a link, as a test uses them."""

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from pebble.bench.frames_process import Worker, end_workers
from pebble.impair.link import Link

_ANSWER_S = 40.0
_PEER = [sys.executable, "-I", str(Path(__file__).with_name("peer.py"))]


class Talk:
    """One connection from the robot's side to the broker's, for as long as it lives."""

    def __init__(self, link: Link, logs: Path) -> None:
        self._server = Worker("server", link.on_remote([*_PEER, "serve", link.broker_host]), logs / "server.log")
        self._workers = [self._server]
        try:
            said = self._server.answer(_ANSWER_S)
            host, port = link.broker_address(said["tcp"])
            command = [*_PEER, "talk", host, str(port), str(said["udp"])]
            self._client = Worker("client", link.on_robot(command), logs / "client.log")
            self._workers.append(self._client)
            self._client.answer(_ANSWER_S)
        except BaseException:
            self.end()
            raise

    def up(self, size: int) -> float:
        """Seconds until so many bytes have been taken and the answer has come back."""
        return float(self._ask(f"up {size}"))

    def down(self, size: int) -> float:
        """Seconds until so many bytes have come from the broker's side."""
        return float(self._ask(f"down {size}"))

    def round_trips(self, n: int = 5) -> list[float]:
        return [self.up(1) for _ in range(n)]

    def send_datagrams(self, n: int) -> None:
        self._ask(f"datagrams {n}")

    def heard_datagrams(self) -> int:
        self._server.tell("heard")
        return int(self._server.answer(_ANSWER_S)["heard"])

    def end(self) -> None:
        end_workers(self._workers)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self.end()

    def _ask(self, line: str) -> Any:
        self._client.tell(line)
        return self._client.answer(_ANSWER_S)["result"]


@contextmanager
def largest_packet(link: Link, logs: Path) -> Iterator[Callable[[], int]]:
    """Bytes of the largest packet, with its Ethernet header, that comes to the broker's side meanwhile."""
    listener = Worker("capture", link.on_remote([*_PEER, "capture"]), logs / "log")
    try:
        listener.answer(_ANSWER_S)

        def largest() -> int:
            listener.tell("largest")
            return int(listener.answer(_ANSWER_S)["largest"])

        yield largest
    finally:
        end_workers([listener])
