"""The files that a recorder writes at present: one for each lane."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Final

from pebble.recordings.files.mcap import Packer
from pebble.recordings.recorder.folder import STATE, Folder
from pebble.recordings.recorder.lane import OTHER_MEDIA, Item, OpenFile, lane_of
from pebble.recordings.recorder.retained import RetainedValues
from pebble.recordings.stamps import is_media

_MOST_MEDIA: Final = 32  # lanes


class OpenFiles:
    """By lane; a file of the state begins with the retained values. Not thread-safe.

    ``about`` is written into each file, and ``watch`` gets all of them whenever that changes.
    """

    def __init__(
        self, folder: Folder, about: Mapping[str, str], packer: Packer, watch: Callable[[list[OpenFile]], None]
    ) -> None:
        self.retained = RetainedValues()
        self._folder, self._about, self._packer, self._watch = folder, about, packer, watch
        self._files: dict[str, OpenFile] = {}

    @property
    def by_lane(self) -> dict[str, OpenFile]:
        """A copy, so that files may be opened and taken meanwhile."""
        return dict(self._files)

    @property
    def paths(self) -> set[Path]:
        return {file.path for file in self._files.values()}

    def lane(self, item: Item) -> str:
        """The lane of a message; media beyond those of so many robots share one."""
        lane = lane_of(item.topic, is_media=is_media(item.payload))
        media = len(self._files) - (STATE in self._files)
        return lane if lane == STATE or lane in self._files or media < _MOST_MEDIA else OTHER_MEDIA

    def get(self, lane: str, *, now_ns: int, at_ns: int) -> OpenFile:
        """The file of a lane, or a new one, begun now, with the values retained at ``at_ns``. Raises OSError."""
        file = self._files.get(lane)
        if file is not None:
            return file
        file = OpenFile(self._folder, lane, now_ns, self._about, self._packer)
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
        """The file, which is not written any more."""
        file = self._files.pop(lane)
        self._watch(list(self._files.values()))
        return file
