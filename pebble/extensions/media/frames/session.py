"""The Zenoh network of one stream of frames: a writer that listens on a socket, and readers connected to it.

It is the same on robots of every transport, and has no hub: docs/decisions/0007.
"""

import json
import re
from pathlib import Path

import zenoh

from pebble.errors import TransportError
from pebble.transports.settings import ZenohSettings
from pebble.transports.socket_paths import check_socket_path
from pebble.transports.zenoh.session import open_session, session_config

#: What Zenoh maps and locks for its own bookkeeping, in every process that shares memory (1.10.2), in bytes.
METADATA = 1_310_720
#: A reader whose writer was restarted misses the frames of the new one until it reconnects.
_RETRY = {"period_init_ms": 100, "period_max_ms": 100, "period_increase_factor": 1.0}
_stream_name = re.compile(r"[a-z][a-z0-9-]{0,31}").fullmatch


class SharingError(TransportError):
    """An error: Zenoh could not create its segments, and would open the session without shared memory."""


class StreamNames:
    """The paths and keys of a stream: its socket and lock files in the run directory, its keys on that socket."""

    def __init__(self, folder: Path, stream: str) -> None:
        if not _stream_name(stream):
            raise TransportError(f'"{stream}" is not a valid stream name: a letter, then letters, digits and dashes')
        self.socket = folder / f"frames-{stream}.sock"
        self.data = f"frames/{stream}/data"
        self.readers = f"frames/{stream}/reader/*"
        self.writers = f"frames/{stream}/writer/*/*/*"  # id, size and segment, see writer()
        self.folder, self.stream = folder, stream
        self._lock_name = f"frames-{stream}.{{}}.life"

    def reader(self, name: str) -> str:
        return self.readers.replace("*", name)

    def writer(self, writer_id: int, size: int, segment: str) -> str:
        """Return the token that a running writer publishes: its id, how many bytes it shares, and its segment."""
        return f"{self.writers.removesuffix('*/*/*')}{writer_id:x}/{size}/{segment or '-'}"

    def writer_of(self, token: str) -> tuple[int, int, str]:
        """Return a writer's id, how many bytes it shares and its segment, from its token. Raises ValueError."""
        *_, writer_id, size, segment = token.split("/")
        return int(writer_id, 16), int(size), segment

    def lock_path(self, writer_id: int) -> Path:
        """Return the file that this writer locks while it is open."""
        return self.folder / self._lock_name.format(f"{writer_id:x}")

    def lock_paths(self) -> list[Path]:
        return list(self.folder.glob(self._lock_name.format("*")))


def open_writing(names: StreamNames, *, shared: bool) -> zenoh.Session:
    """Open the writer's session. Raises TransportError if it cannot listen, for example beside another writer."""
    check_socket_path(names.socket)
    return _open(names, [names.socket], [], shared=shared)


def open_reading(names: StreamNames, *, shared: bool) -> zenoh.Session:
    """Open a reader's session. The writer need not be running yet."""
    return _open(names, [], [names.socket], shared=shared)


def _open(names: StreamNames, listen: list[Path], connect: list[Path], *, shared: bool) -> zenoh.Session:
    config = json.loads(session_config(ZenohSettings(run_dir=names.folder), "peer", listen=listen, connect=connect))
    config["connect"]["retry"] = _RETRY
    # Implicit sharing would copy once per reader into a second pool, and share frames that are sent as bytes.
    config["transport"]["shared_memory"] = {
        "enabled": shared,
        # "init" creates segments even if sharing is off, and panics if they cannot be locked.
        "mode": "init" if shared else "lazy",
        "transport_optimization": {"enabled": False},
    }
    try:
        return open_session(json.dumps(config))
    except zenoh.ZError as error:
        kind = SharingError if shared and "shm" in str(error) else TransportError
        raise kind(f"frames at {names.socket}: {error}") from None
    except BaseException as error:
        if not shared or type(error).__name__ != "PanicException":  # pyo3's, which is no Exception and not importable
            raise
        raise SharingError(f"no shared memory for frames at {names.socket}: {error}") from None
