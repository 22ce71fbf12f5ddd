"""The bytes of TCPROS: headers of connections, and blocks that begin with their length. Pure."""

import struct

from pebble.errors import PebbleError

MOST_HEADER = 65_536  # bytes of the header of a connection, and of a call of the node's API
MOST_MESSAGE = 1 << 20  # bytes of a message that is received


class RosError(PebbleError):
    """An error of the master or of a node: it refuses, or answers with something else."""


def block(body: bytes) -> bytes:
    """Return ``body`` with its length before it."""
    return struct.pack("<I", len(body)) + body


def pack_header(**fields: str) -> bytes:
    """Return the first block of a connection, with these fields."""
    return block(b"".join(block(f"{key}={value}".encode()) for key, value in fields.items()))


def parse_header(body: bytes) -> dict[str, str]:
    """Return the fields of a header; damaged ones are left out."""
    fields, at = {}, 0
    while at + 4 <= len(body):
        (size,) = struct.unpack_from("<I", body, at)
        key, _, value = body[at + 4 : at + 4 + size].decode("utf-8", "replace").partition("=")
        fields[key] = value
        at += 4 + size
    return fields


class Blocks:
    """A splitter of received bytes into blocks of at most ``most`` bytes."""

    def __init__(self, most: int) -> None:
        self.most, self._data = most, bytearray()

    def feed(self, chunk: bytes) -> list[bytes]:
        """Return the blocks that ``chunk`` completes. Raises RosError if a block is too long."""
        self._data += chunk
        blocks = []
        while len(self._data) >= 4:
            (size,) = struct.unpack_from("<I", self._data)
            if size > self.most:
                raise RosError(f"a message of {size} bytes, and {self.most} are the most")
            if len(self._data) < 4 + size:
                break
            blocks.append(bytes(self._data[4 : 4 + size]))
            del self._data[: 4 + size]
        return blocks
