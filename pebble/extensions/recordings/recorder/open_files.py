"""The files that a recorder is writing, one for each lane: the state of all robots, and the media of each robot."""

from collections.abc import Callable, Iterator, Mapping
from typing import Final

from pebble.extensions.recordings.recorder.folder import STATE, Folder
from pebble.extensions.recordings.recorder.lane import CARRIED, OTHER_MEDIA, Item, OpenFile, lane_of
from pebble.extensions.recordings.stamps import is_media
from pebble.transports.bounds import BoundedTable

_MOST_MEDIA: Final = 32  # lanes
_TOPICS, _BYTES = 10_000, 16 << 20


class RetainedValues:
    """The newest retained values, by connection and topic. A new file begins with them."""

    def __init__(self) -> None:
        self._values = BoundedTable[Item](_TOPICS, _BYTES, lambda item: len(item.payload))

    def note(self, item: Item) -> None:
        """Note a message that was published to be retained.

        Where the transport does not tell that, note each message on a topic that has a retained value already.
        """
        # ``item.retain``: it was published to be retained. ``item.retained``: it came as an old value.
        key = f"{item.source} {item.topic}"
        stored = self._values.get(key)
        if item.retained and stored is not None and not stored.retained:
            return  # an old value, fetched by another connection, while a live message has come
        is_retained = item.retain
        if is_retained is None:
            is_retained = stored is not None
        if not is_retained:
            return
        if item.payload:
            self._values[key] = item._replace(retain=True)
        else:
            self._values.pop(key, None)

    def forget(self, source: str) -> None:
        """Forget a connection's values, because they will be fetched again."""
        for key in [key for key in self._values if key.startswith(f"{source} ")]:
            del self._values[key]

    def carried(self) -> Iterator[Item]:
        """Yield the values with which a new file begins."""
        for item in list(self._values.values()):
            yield item._replace(retained=CARRIED)


class OpenFiles:
    """The open files by lane; a state file begins with the retained values. Not thread-safe.

    ``about`` is written into each file. ``watch`` is called with all files when they change.
    """

    def __init__(self, folder: Folder, about: Mapping[str, str], watch: Callable[[list[OpenFile]], None]) -> None:
        self.retained = RetainedValues()
        self._folder, self._about, self._watch = folder, about, watch
        self._files: dict[str, OpenFile] = {}

    @property
    def by_lane(self) -> dict[str, OpenFile]:
        """Return a copy of the table, so that files may be opened and taken during an iteration."""
        return dict(self._files)

    def lane(self, item: Item) -> str:
        """Return the lane of a message. Beyond a number of robots, their media share a lane."""
        lane = lane_of(item.topic, is_media=is_media(item.payload))
        media = len(self._files) - (STATE in self._files)
        return lane if lane == STATE or lane in self._files or media < _MOST_MEDIA else OTHER_MEDIA

    def get(self, lane: str, *, now_ns: int, at_ns: int) -> OpenFile:
        """Return a lane's file. Raises OSError.

        A new one is named after ``now_ns``. If it is of the state, it begins with the retained values, as of ``at_ns``.
        """
        file = self._files.get(lane)
        if file is not None:
            return file
        file = OpenFile(self._folder, lane, now_ns, self._about)
        if lane == STATE:
            try:
                for value in self.retained.carried():
                    file.add(value, at_ns)
            except OSError:
                file.discard()
                raise
        self._files[lane] = file
        self._watch(list(self._files.values()))
        return file

    def take(self, lane: str) -> OpenFile:
        """Remove a file from the table, and return it."""
        file = self._files.pop(lane)
        self._watch(list(self._files.values()))
        return file
