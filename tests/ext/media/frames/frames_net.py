"""Starts, asks, stops and kills the processes of `frames_peer`."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec

from tests.ext.media.frames.frames_peer import Options
from tests.support import until
from tests.transports.forked import Forked


class Peer:
    """One process; `ask` for its numbers."""

    def __init__(self, role: str, folder: Path, options: Options) -> None:
        arguments = (role, str(folder), msgspec.json.encode(options).decode())
        self._process = Forked("tests.ext.media.frames.frames_peer", *arguments)
        assert self._line() == "up"

    def ask(self) -> dict[str, Any]:
        self._process.stdin.write("?\n")
        self._process.stdin.flush()
        answer: dict[str, Any] = json.loads(self._line())
        return answer

    def reaches(self, condition: Callable[[dict[str, Any]], object], timeout: float = 10.0) -> dict[str, Any]:
        """Ask until ``condition`` is true for an answer, and return that."""
        answers: list[dict[str, Any]] = [{}]

        def asked() -> object:
            answers.append(self.ask())
            return condition(answers[-1])

        assert until(asked, timeout, step=0.02), answers[-1]
        return answers[-1]

    def has(self, **least: int) -> dict[str, Any]:
        """Ask until every number is at least as given."""
        return self.reaches(lambda answer: all(answer.get(name, 0) >= number for name, number in least.items()))

    @property
    def pid(self) -> int:
        return self._process.pid

    def close(self) -> int | None:
        """Its exit code after a polite end."""
        self._process.stdin.close()
        return self._end()

    def kill(self) -> None:
        self._process.kill()
        self._end()

    def _end(self) -> int | None:
        try:
            return self._process.wait(10)
        finally:
            for pipe in (self._process.stdin, self._process.stdout):
                with contextlib.suppress(BrokenPipeError):
                    pipe.close()

    def _line(self) -> str:
        return self._process.stdout.readline().strip()

    @property
    def running(self) -> bool:
        return self._process.poll() is None


class FramesNet:
    """A run directory and its peers; `close` ends them all."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir(mode=0o700, exist_ok=True)
        self._peers: list[Peer] = []

    def writer(self, **options: Any) -> Peer:
        return self._start("writer", Options(**options))

    def reader(self, **options: Any) -> Peer:
        return self._start("reader", Options(**options))

    def _start(self, role: str, options: Options) -> Peer:
        peer = Peer(role, self.folder, options)
        self._peers.append(peer)
        return peer

    def close(self) -> None:
        for peer in self._peers:
            if peer.running:
                peer.kill()
