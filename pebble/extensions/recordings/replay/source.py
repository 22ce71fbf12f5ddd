"""The source of a replay: the messages of recordings from any time on, and the state at that time."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Final

from pebble.contract import HEARTBEAT, ONLINE, OUTGOING, Kind, channel_of
from pebble.extensions.recordings.files.reader import Chooses, RecordingFile
from pebble.extensions.recordings.files.recorded import Channel, Recorded
from pebble.extensions.recordings.library import FOREVER_NS, Damages, merged, reaches_into
from pebble.extensions.recordings.stamps import is_keyframe, is_picture

#: How far before a time its state and its last key frame are looked for. A file of states is then read from its begin.
STATE_NS: Final = 600 * 10**9
PICTURES_NS: Final = 60 * 10**9
_PICTURES: Final = 2000  # of one topic since its key frame; more are no help to a decoder
_HEARTBEATS: Final = frozenset({ONLINE.suffix, HEARTBEAT.suffix})


class ReplaySource:
    """Recordings as one stream. After a seek it begins with the state that a subscriber would know."""

    def __init__(self, paths: Iterable[Path]) -> None:
        """Read the end of each file, or all of an unfinished one. Raises RecordingError."""
        self._files: dict[Path, list[Channel]] = {}
        self.damages = Damages()  # of what was read
        for path in paths:
            with RecordingFile(path) as file:
                self._files[path] = list(file.channels.values())
                if not file.chunks:
                    self.damages[path] = file.damage

    @property
    def channels(self) -> list[Channel]:
        return [channel for channels in self._files.values() for channel in channels]

    def messages(self, since_ns: int = 0, until_ns: int = FOREVER_NS) -> Iterator[Recorded]:
        """Yield messages in the order of their arrival, up to before ``until_ns``."""
        return merged(self._files, since_ns=since_ns, until_ns=until_ns, damages=self.damages)

    def state_before(self, at_ns: int, publishes: Chooses = lambda _channel: True) -> list[Recorded]:
        """Return each topic's newest retained message, then all pictures since each topic's last key frame.

        Only of channels that ``publishes`` accepts; no heartbeats, since an old one is no sign of life.
        """
        newest: dict[str, Recorded] = {}

        def chooses(channel: Channel) -> bool:
            return _is_state(channel) and publishes(channel)

        for message in merged(self._having(chooses, at_ns - STATE_NS, at_ns), until_ns=at_ns, chooses=chooses):
            newest.pop(message.channel.topic, None)  # it moves to the end
            if message.payload:  # an empty one removes the retained message
                newest[message.channel.topic] = message
        return [*newest.values(), *self._pictures_before(at_ns, publishes)]

    def _pictures_before(self, at_ns: int, publishes: Chooses) -> list[Recorded]:
        since_ns = max(0, at_ns - PICTURES_NS)

        def chooses(channel: Channel) -> bool:
            return _may_be_pictures(channel) and publishes(channel)

        since_keyframe: dict[str, list[Recorded]] = {}
        paths = self._having(chooses, since_ns, at_ns)
        for message in merged(paths, since_ns=since_ns, until_ns=at_ns, chooses=chooses):
            if is_keyframe(message.payload):
                since_keyframe[message.channel.topic] = [message]
            elif message.channel.topic in since_keyframe and is_picture(message.payload):
                since_keyframe[message.channel.topic].append(message)
        pictures = [
            message for messages in since_keyframe.values() if len(messages) <= _PICTURES for message in messages
        ]
        return sorted(pictures, key=lambda message: message.log_ns)

    def _having(self, chooses: Callable[[Channel], bool], since_ns: int, until_ns: int) -> list[Path]:
        """Return the files of that time with channels that ``chooses`` accepts, so that only these are decompressed."""
        having = [path for path, channels in self._files.items() if any(map(chooses, channels))]
        return [path for path in having if reaches_into(path, since_ns, until_ns)]


def _is_state(channel: Channel) -> bool:
    """True if a new subscriber would get the newest message of the topic at once."""
    suffix = _suffix(channel)
    if not suffix.startswith(f"{OUTGOING}/") or suffix in _HEARTBEATS:
        return False
    declared = channel_of(suffix)
    retains = "1" in (channel.metadata.get("retain"), channel.metadata.get("retained"))
    return retains or (declared is not None and declared.kind is Kind.STATE)


def _may_be_pictures(channel: Channel) -> bool:
    declared = channel_of(_suffix(channel))
    binary = declared is None or declared.payload is bytes
    return binary and _suffix(channel).startswith(f"{OUTGOING}/") and not _is_state(channel)


def _suffix(channel: Channel) -> str:
    """Return the topic below the identity; empty for topics in another form than the contract's."""
    levels = channel.topic.split("/", 3)
    return levels[3] if len(levels) > 3 else ""
