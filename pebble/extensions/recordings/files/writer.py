"""A writer of MCAP files that loses only what is not flushed when its process is killed."""

from __future__ import annotations

from collections.abc import Mapping
from io import BufferedIOBase
from typing import TYPE_CHECKING, Final, Protocol

from pebble.extensions.recordings.files.recorded import require_package
from pebble.version import __version__

if TYPE_CHECKING:
    from mcap.records import Channel

LIBRARY: Final = f"pebble {__version__}"
MOST_CHANNELS: Final = (1 << 16) - 1  # of one file: their numbers have 16 bits
_NAMES_AGAIN_NS: Final = 60 * 10**9
_CHUNK: Final = b"\x06"


class File(Protocol):
    """An unbuffered file for the bytes. ``write`` may take only a part of them."""

    def write(self, data: memoryview, /) -> int | None: ...


class RecordingWriter:
    """A recording being written. :meth:`flush` it at least once a second, and :meth:`finish` it."""

    def __init__(self, file: File, library: str = LIBRARY) -> None:
        """Begin a file. Raises OSError, as all methods do, and RecordingError without the package ``mcap``."""
        require_package()
        from mcap.writer import Writer

        self.messages = 0  # that were added
        self.channels = 0  # that were declared
        self.indexed = 0  # sum of the channels of each chunk: the package keeps an index of each in memory
        self._output = _Output(self, file)
        self._writer = Writer(self._output)  # type: ignore[arg-type]
        self._named: list[Channel] = []  # that were declared before the last flush
        self._new: list[Channel] = []  # that were declared since then
        self._used: set[int] = set()  # channels with messages since then
        self._log_ns = self._names_again_ns = 0  # of the newest message; when all channels are declared again
        self._writer.start(library=library)

    @property
    def size(self) -> int:
        """Return the number of bytes written to the file."""
        return self._output.size

    @property
    def flushed(self) -> int:
        """Return the number of messages written to the file."""
        return self._output.messages

    def metadata(self, name: str, items: Mapping[str, str]) -> None:
        """Add metadata about the file."""
        self._writer.add_metadata(name, dict(items))

    def schema(self, name: str, encoding: str, data: bytes) -> int:
        """Declare the schema of messages; return its number for :meth:`channel`."""
        number: int = self._writer.register_schema(name, encoding, data)
        return number

    def channel(self, topic: str, encoding: str, metadata: Mapping[str, str], schema: int = 0) -> int:
        """Declare a channel, one of MOST_CHANNELS; return its number for :meth:`add`."""
        from mcap.records import Channel

        number = self._writer.register_channel(topic, encoding, schema, dict(metadata))
        self._new.append(Channel(number, topic, encoding, dict(metadata), schema))
        self.channels += 1
        return number

    def add(self, channel: int, log_ns: int, payload: bytes, publish_ns: int = 0) -> None:
        """Add a message that was received at ``log_ns``. ``publish_ns``: its own stamp; 0: it has none."""
        number, self.messages = self.messages, self.messages + 1
        self._log_ns = log_ns
        self._used.add(channel)
        self._writer.add_message(channel, log_ns, payload, publish_ns, number & 0xFFFFFFFF)

    def flush(self) -> None:
        """Write all that was added to the file.

        The package ``mcap`` declares a channel once, inside a chunk, which damage may destroy. So new channels are also
        declared before their chunk, and all channels again once a minute.
        """
        self._named += self._new
        due, self._new = self._new, []
        if self._log_ns >= self._names_again_ns:
            due, self._names_again_ns = self._named, self._log_ns + _NAMES_AGAIN_NS
        if due and self.messages:  # else none yet: by the time of the first message all channels will be due
            self._output.write(_packed(due))
        self._writer.flush()
        self.indexed += len(self._used)
        self._used.clear()

    def finish(self) -> None:
        """Write the summary: the file is complete."""
        self._writer.finish()


class _Output(BufferedIOBase):
    """The file as the package ``mcap`` writes to it: each of its calls is written completely."""

    def __init__(self, writer: RecordingWriter, file: File) -> None:
        self.size = 0
        self.messages = 0  # that are in the file
        self._writer, self._file = writer, file

    def write(self, data: bytes) -> int:  # type: ignore[override]
        unwritten = memoryview(data)
        while unwritten:
            taken = self._file.write(unwritten)  # None: nothing
            unwritten = unwritten[taken or 0 :]
        self.size += len(data)
        if data[:1] == _CHUNK:  # written in one call, with all messages that were added before
            self.messages = self._writer.messages
        return len(data)

    def seek(self, _offset: int, _whence: int = 0) -> int:
        """Return the position, which is always the end; the package only asks for it."""
        return self.size


def _packed(channels: list[Channel]) -> bytes:
    """Return the declarations of those channels that have no schema, to repeat them where damage does not reach them.

    For other channels the schema would have to be repeated as well.
    """
    from mcap.data_stream import RecordBuilder

    builder = RecordBuilder()
    for channel in channels:
        if not channel.schema_id:
            channel.write(builder)
    packed: bytes = builder.end()
    return packed
