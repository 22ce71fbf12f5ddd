"""The fabric of one stream of frames: a writer that listens at a socket of its own, and readers that connect to it.

It is the same on robots of every transport, and knows no hub: docs/decisions/0007.
"""

from __future__ import annotations

import json
import os
import re
from pathlib import Path

import zenoh

from pebble.errors import TransportError
from pebble.transports.dead_pools import Pool, pool
from pebble.transports.settings import ZenohSettings
from pebble.transports.zenoh_session import open_session, session_config

#: What Zenoh maps and locks for its own bookkeeping, in every process that shares memory (1.10.2), in bytes.
METADATA = 1_310_720
#: A reader whose writer was restarted misses what the new one writes to others until it has tried again.
_RETRY = {"period_init_ms": 100, "period_max_ms": 100, "period_increase_factor": 1.0}
_SOCKET_PATH_LIMIT = 108  # bytes, sizeof(sun_path)
_stream_name = re.compile(r"[a-z][a-z0-9-]{0,31}").fullmatch


class SharingError(TransportError):
    """Zenoh could not make its segments; without shared memory the same session would open."""


class StreamNames:
    """Where a stream is: its socket in the run directory, its keys on that socket."""

    def __init__(self, folder: Path, stream: str) -> None:
        if not _stream_name(stream):
            raise TransportError(f'"{stream}" is no name of a stream: a letter, then letters, digits and dashes')
        self.socket = folder / f"frames-{stream}.sock"
        self.data = f"frames/{stream}/data"
        self.readers = f"frames/{stream}/reader/*"
        self.writers = f"frames/{stream}/writer/*/*/*"
        self._lives = f"frames-{stream}.{{}}.life"
        self._folder = folder

    def reader(self, name: str) -> str:
        return self.readers.replace("*", name)

    def writer(self, life: int, size: int, segment: str) -> str:
        """The token of a living writer also says how much memory it shares, in bytes, and in which segment."""
        return f"{self.writers.removesuffix('*/*/*')}{life:x}/{size}/{segment or '-'}"

    def writer_of(self, token: str) -> tuple[int, Pool]:
        """The life and the memory of the writer with this token. Raises ValueError for what is none."""
        *_, life, size, segment = token.split("/")
        number = int(life, 16)
        return number, pool("" if segment == "-" else segment, int(size), self.life(number))

    def life(self, life: int) -> Path:
        """A file that a writer keeps locked."""
        return self._folder / self._lives.format(f"{life:x}")

    def lives(self) -> list[Path]:
        return list(self._folder.glob(self._lives.format("*")))


def open_writing(folder: Path, names: StreamNames, *, shared: bool) -> zenoh.Session:
    """Raises TransportError if nobody can listen there, for example because another writer does."""
    if len(os.fsencode(names.socket)) >= _SOCKET_PATH_LIMIT:
        raise TransportError(f"{names.socket} is too long for a unix socket: set transport.run_dir to a shorter path")
    return _open(folder, [names.socket], [], shared=shared)


def open_reading(folder: Path, names: StreamNames, *, shared: bool) -> zenoh.Session:
    """The writer need not be there yet."""
    return _open(folder, [], [names.socket], shared=shared)


def _open(folder: Path, listen: list[Path], connect: list[Path], *, shared: bool) -> zenoh.Session:
    config = json.loads(session_config(ZenohSettings(run_dir=folder), "peer", listen=listen, connect=connect))
    config["connect"]["retry"] = _RETRY
    # Implicit sharing would copy once per reader into a second pool, and share what was meant to go as bytes.
    config["transport"]["shared_memory"] = {
        "enabled": shared,
        # "init" makes segments even where sharing is off, and panics if they cannot be locked.
        "mode": "init" if shared else "lazy",
        "transport_optimization": {"enabled": False},
    }
    try:
        return open_session(json.dumps(config))
    except zenoh.ZError as error:
        raise TransportError(f"frames at {(listen or connect)[0]}: {error}") from None
    except BaseException as error:
        if not shared or type(error).__name__ != "PanicException":  # pyo3's, which is no Exception and not importable
            raise
        raise SharingError(f"no shared memory for frames at {(listen or connect)[0]}: {error}") from None
