"""The source of a replay: the messages of recordings from any time on, and the state at that time."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from operator import attrgetter
from pathlib import Path
from typing import Final

from pebble.contract import HEARTBEAT, ONLINE, OUTGOING, Kind, channel_of
from pebble.extensions.recordings.files.reader import Chooses, RecordingFile, missing_before
from pebble.extensions.recordings.files.recorded import FOREVER_NS, Channel, Recorded
from pebble.extensions.recordings.library import Damages, merged, robots_of
from pebble.extensions.recordings.seek.archive import Archive

_HEARTBEATS: Final = frozenset({ONLINE.suffix, HEARTBEAT.suffix})
_time = attrgetter("log_ns")


class ReplaySource:
    """Recordings as one stream. After a seek it begins with the state that a subscriber would know."""

    def __init__(self, paths: Iterable[Path]) -> None:
        """Read the end of each file, or all of an unfinished one. Raises RecordingError."""
        self._paths, self.channels = list(paths), list[Channel]()
        self.damages = Damages()  # of what was read
        self.missing = 0  # messages that were missing already when these files were mended
        for path in self._paths:
            with RecordingFile(path) as file:
                self.channels += file.channels.values()
                self.missing += missing_before(file.metadata())
                if not file.chunks:  # nothing can be read of it; damage of other files shows while they are read
                    self.damages[path] = file.damage
        self._archive = Archive(*self._paths)

    def messages(self, since_ns: int = 0, until_ns: int = FOREVER_NS) -> Iterator[Recorded]:
        """Yield messages in the order of their arrival, up to before ``until_ns``."""
        return merged(self._paths, since_ns=since_ns, until_ns=until_ns, damages=self.damages)

    def state_before(self, at_ns: int, publishes: Chooses = lambda _channel: True) -> list[Recorded]:
        """Return each topic's newest retained message, then each robot's last pictures, from a key frame on.

        Only of channels that ``publishes`` accepts; no heartbeats, since an old one is no sign of life.
        """
        state, pictures = list[Recorded](), list[Recorded]()
        for robot in robots_of(filter(publishes, self.channels)):
            state += filter(_is_state, self._archive.state(robot, at_ns))
            pictures += self._archive.pictures(robot, at_ns)
        messages = [*sorted(state, key=_time), *sorted(pictures, key=_time)]
        return [message for message in messages if publishes(message.channel)]


def _is_state(message: Recorded) -> bool:
    """True if a new subscriber would get the message at once. False if it is empty, to remove a retained one."""
    levels = message.channel.topic.split("/", 3)
    suffix = levels[3] if len(levels) > 3 else ""
    if not message.payload or not suffix.startswith(f"{OUTGOING}/") or suffix in _HEARTBEATS:
        return False
    declared = channel_of(suffix)
    metadata = message.channel.metadata
    retains = "1" in (metadata.get("retain"), metadata.get("retained"))  # published so; or an old one, thus retained
    return retains or (declared is not None and declared.kind is Kind.STATE)
