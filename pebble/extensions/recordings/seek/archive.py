"""An archive: recordings from which a robot's state, messages and picture at a time are read."""

import time
from collections.abc import Iterator
from datetime import UTC, datetime
from itertools import islice
from operator import attrgetter
from pathlib import Path
from typing import Final, NamedTuple

from pebble.contract import INCOMING
from pebble.contract.channels import LOGS
from pebble.contract.identity import parse_topic
from pebble.errors import PebbleError
from pebble.extensions.recordings.files.reader import Chunk, RecordingFile
from pebble.extensions.recordings.files.recorded import FOREVER_NS, Channel, Recorded
from pebble.extensions.recordings.library import recordings_in
from pebble.extensions.recordings.recorder.folder import MEDIA, NAME
from pebble.extensions.recordings.recorder.lane import CARRIED, OTHER_MEDIA, lane_of
from pebble.extensions.recordings.stamps import is_keyframe, is_media, is_picture

LOG_LINES: Final = 50  # of the state at a time
_LOG_NS: Final = 600 * 10**9
#: A key frame is looked for so far back: robots send one at least every ten seconds.
_CHAIN_NS, _CHAIN_BYTES = 15 * 10**9, 8 << 20
LIST_S: Final = 1.0  # between two looks at the folder
_LONGEST_FILE_NS: Final = 25 * 3600 * 10**9
_MOST_OPEN: Final = 64  # files that are open at once
_time = attrgetter("log_ns")


class _Named(NamedTuple):
    """A file, and the facts in its name if a recorder has named it."""

    path: Path
    lane: str  # what the file holds, see recorder.lane; "": anything
    begins_ns: int  # 0: not known


class Archive:
    """The recordings in ``places``, files or folders. Not thread-safe."""

    def __init__(self, *places: Path) -> None:
        self._places = places
        self._named: list[_Named] = []  # the files in these places
        self._listed_at = float("-inf")  # when they were last listed
        self._open: dict[Path, RecordingFile] = {}
        self._failed: dict[Path, str] = {}  # why a file cannot be opened

    def close(self) -> None:
        while self._open:
            self._open.popitem()[1].close()

    def messages(self, robot: str, since_ns: int, until_ns: int) -> list[Recorded]:
        """Return the messages from and to a robot, from ``since_ns`` to before ``until_ns``."""
        messages: list[Recorded] = []
        for file in self.files(robot, since_ns, until_ns):
            messages += _new_messages(file, robot, since_ns, until_ns)
        messages.sort(key=_time)
        return messages

    def state(self, robot: str, at_ns: int) -> list[Recorded]:
        """Return the newest message of each of a robot's topics before ``at_ns``, without media, oldest first."""
        files = self.files(robot, at_ns - _LONGEST_FILE_NS, at_ns, media=False)
        files = [file for file in files if file.first_ns < at_ns]
        if not files:
            return []
        file = max(files, key=lambda file_: file_.first_ns)  # it begins with what was retained before it
        topics = {channel.topic for channel in file.channels.values() if _is_of(channel, robot)}
        newest: dict[str, Recorded] = {}
        for chunk in reversed(_within(file, _channels_of(file, robot), 0, at_ns)):
            missing = topics - newest.keys()
            if not missing:
                break
            if not _may_hold(file, chunk, missing):
                continue
            for message in reversed(file.messages(chunk)):
                topic = message.channel.topic
                if message.log_ns < at_ns and topic not in newest and _is_of(message.channel, robot):
                    newest[topic] = message
        return sorted((message for message in newest.values() if not is_media(message.payload)), key=_time)

    def log_lines(self, robot: str, at_ns: int) -> list[Recorded]:
        """Return the last lines of a robot's log before ``at_ns``, oldest first."""
        topic, since_ns = LOGS.topic(robot), at_ns - _LOG_NS
        newest_first: list[Recorded] = []
        for file in reversed(self.files(robot, since_ns, at_ns, media=False)):
            numbers = frozenset(number for number, channel in file.channels.items() if channel.topic == topic)
            lines = messages_of(file, numbers, since_ns, at_ns, backwards=True)
            newest_first += islice(lines, LOG_LINES - len(newest_first))
        return sorted(newest_first, key=_time)

    def pictures(self, robot: str, at_ns: int) -> list[Recorded]:
        """Return the last picture before ``at_ns``, preceded by those that it builds on; empty if there is none."""
        chain: list[Recorded] = []
        size = 0
        for message in self._pictures_before(robot, at_ns):
            if chain and message.channel.topic != chain[-1].channel.topic:
                continue
            chain.append(message)
            size += len(message.payload)
            if is_keyframe(message.payload):
                chain.reverse()
                return chain
            if size > _CHAIN_BYTES:
                break
        return []

    def next_ns(self, robot: str, at_ns: int) -> int | None:
        """Return the time of the first message of the robot from ``at_ns`` on; None if there is none."""
        earliest_ns = FOREVER_NS
        for file in self.files(robot, at_ns, FOREVER_NS):
            if file.first_ns >= earliest_ns:  # and so are all that follow, in the order of time
                break
            first = next(_new_messages(file, robot, at_ns, earliest_ns), None)
            if first is not None:
                earliest_ns = first.log_ns
        return None if earliest_ns == FOREVER_NS else earliest_ns

    def files(self, robot: str, since_ns: int, until_ns: int, *, media: bool = True) -> list[RecordingFile]:
        """Return the files that may hold messages of a robot in a period, opened, in the order of time."""
        media_lanes = (lane_of(f"{robot}/", is_media=True), OTHER_MEDIA) if media else ()
        files = []
        for named in self._list():
            if named.lane.startswith(MEDIA) and named.lane not in media_lanes:
                continue
            may_overlap = since_ns - _LONGEST_FILE_NS <= named.begins_ns < until_ns
            if named.begins_ns and not may_overlap:  # 0: the name does not tell when it begins
                continue
            file = self._opened(named.path)
            if file is None or not file.chunks or file.first_ns >= until_ns or file.last_ns < since_ns:
                continue
            files.append(file)
        return sorted(files, key=lambda file_: file_.first_ns)

    def all_files(self) -> Iterator[RecordingFile]:
        """Yield all files, each opened."""
        files = (self._opened(named.path) for named in self._list())
        yield from (file for file in files if file is not None)

    def unread(self) -> dict[Path, str]:
        """Return what could not be read, by file, of the files that were opened."""
        return self._failed | {path: file.problem for path, file in self._open.items() if file.problem}

    # -- files

    def _list(self) -> list[_Named]:
        """Return the files by name. The folder is looked at once a second; files that are gone are closed."""
        now = time.monotonic()
        if now - self._listed_at >= LIST_S:
            paths = (path for place in self._places for path in (recordings_in(place) if place.is_dir() else (place,)))
            self._named = sorted(_named(path) for path in paths if path.is_file())
            self._listed_at = now
            there = {named.path for named in self._named}
            for path in self._open.keys() - there:
                self._open.pop(path).close()
            self._failed = {path: why for path, why in self._failed.items() if path in there}
        return self._named

    def _opened(self, path: Path) -> RecordingFile | None:
        """Return a file, opened; None if it is gone or is no recording."""
        file = self._open.pop(path, None)
        try:
            if file is not None and file.is_replaced():
                file.close()
                file = None
            if file is None:
                file = RecordingFile(path)
            file.refresh()
        except (PebbleError, OSError) as error:
            self._failed[path] = str(error).removeprefix(f"{path}: ")
            if file is not None:
                file.close()
            return None
        self._failed.pop(path, None)
        self._open[path] = file  # the last one used is the last one closed
        while len(self._open) > _MOST_OPEN:
            self._open.pop(next(iter(self._open))).close()
        return file

    def _pictures_before(self, robot: str, at_ns: int) -> Iterator[Recorded]:
        """Yield the pictures before a time, newest first."""
        since_ns = at_ns - _CHAIN_NS
        for file in reversed(self.files(robot, since_ns, at_ns)):
            for message in messages_of(file, _channels_of(file, robot), since_ns, at_ns, backwards=True):
                if message.channel.topic.startswith(f"{robot}/outgoing/") and is_picture(message.payload):
                    yield message


def metric_of(topic: str) -> tuple[str, bool]:
    """Return the part of a topic after ``incoming/`` or ``outgoing/``, and whether it was sent to the robot."""
    parsed = parse_topic(topic)
    if parsed is None:
        return topic, False
    return parsed.metric, parsed.direction == INCOMING


def messages_of(
    file: RecordingFile, channels: frozenset[int], since_ns: int, until_ns: int, *, backwards: bool = False
) -> Iterator[Recorded]:
    """Yield a file's messages of a period and of the channels with these numbers; ``backwards``: the newest first."""
    step = -1 if backwards else 1
    for chunk in _within(file, channels, since_ns, until_ns)[::step]:
        for message in file.messages(chunk)[::step]:
            if since_ns <= message.log_ns < until_ns and message.channel.id in channels:
                yield message


def _new_messages(file: RecordingFile, robot: str, since_ns: int, until_ns: int) -> Iterator[Recorded]:
    """Yield a robot's messages of a period, without those that were copied to the beginning of the file."""
    for message in messages_of(file, _channels_of(file, robot), since_ns, until_ns):
        if message.channel.metadata.get("retained") != CARRIED:
            yield message


def _within(file: RecordingFile, channels: frozenset[int], since_ns: int, until_ns: int) -> list[Chunk]:
    """Return the chunks of a period that hold messages of these channels."""
    return [
        chunk
        for chunk in file.chunks
        if chunk.end_ns >= since_ns
        and chunk.start_ns < until_ns
        and (not chunk.channels or not chunk.channels.isdisjoint(channels))  # none: not known
    ]


def _may_hold(file: RecordingFile, chunk: Chunk, topics: set[str]) -> bool:
    """True if the chunk has a message of one of the topics, or if its channels are not known."""
    channels = (file.channels[number] for number in chunk.channels if number in file.channels)
    return not chunk.channels or any(channel.topic in topics for channel in channels)


def _channels_of(file: RecordingFile, robot: str) -> frozenset[int]:
    return frozenset(number for number, channel in file.channels.items() if _is_of(channel, robot))


def _is_of(channel: Channel, robot: str) -> bool:
    return channel.topic.startswith((f"{robot}/outgoing/", f"{robot}/incoming/"))


def _named(path: Path) -> _Named:
    """Return the file with the facts that its name tells; a file with another name may hold anything."""
    match = NAME.fullmatch(path.name)
    if match is None:
        return _Named(path, "", 0)
    try:
        begins = datetime.strptime(match["stamp"], "%Y%m%dT%H%M%SZ").replace(tzinfo=UTC)
    except ValueError:
        return _Named(path, "", 0)
    return _Named(path, match["lane"], int(begins.timestamp()) * 10**9)
