"""The contents of recordings, read from their summaries if they have one."""

import json
from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from pebble.config.visible import shown
from pebble.contract.identity import composed
from pebble.extensions.recordings.files.reader import DAMAGE, RecordingFile, missing_before
from pebble.extensions.recordings.files.recorded import ACTIVE, FOREVER_NS, Channel, Recorded, RecordingError
from pebble.extensions.recordings.library import is_of, merged, robot_of, robots_of
from pebble.extensions.recordings.recorder.intake import EVENTS, FORGET
from pebble.transports.topics import matches

_SHOWN_EVENTS: Final = frozenset({"gap", "clock", "dropped", "pruned", "recovered", "damaged", "removed"})
_LISTED: Final = 20  # names that a message lists


@dataclass(slots=True)
class FileInfo:
    """The contents of one recording file."""

    path: Path
    size: int
    messages: int = 0
    first_ns: int = 0
    last_ns: int = 0
    missing: int = 0  # messages that damage has taken
    finished: bool = True
    damaged: bool = False
    readable: bool = True
    problem: str = ""  # what could not be read of it now
    topics: Counter[str] = field(default_factory=Counter)  # messages by topic
    robots: set[str] = field(default_factory=set)

    @property
    def notes(self) -> int:
        """Return how many of the messages are notes of the recorder."""
        return self.topics[EVENTS] + self.topics[FORGET]

    @property
    def is_active(self) -> bool:
        """True if it is being written, or its recorder was killed."""
        return self.path.name.endswith(ACTIVE)


def look_at(path: Path, *, whole: bool = False, since_ns: int = 0, until_ns: int = FOREVER_NS) -> FileInfo:
    """Return a file's contents, from its summary or by reading all of it. Raises RecordingError.

    All of it is read if it has no summary, or with ``whole``. Only messages from ``since_ns`` to before ``until_ns``
    count.
    """
    with RecordingFile(path) as file:
        info = FileInfo(path, file.size)
        is_inside = not file.chunks or (file.first_ns >= since_ns and file.last_ns < until_ns)
        if file.statistics is None or whole or not is_inside:
            _read_all(info, file, since_ns, until_ns)
        else:
            _read_summary(info, file, file.statistics)
        metadata = file.metadata()
        info.missing = file.damage.missing + missing_before(metadata)
        info.finished = file.damage.finished
        info.damaged = bool(file.damage.parts) or DAMAGE in metadata
        info.problem = file.problem
    return info


def _read_summary(info: FileInfo, file: RecordingFile, statistics: Any) -> None:
    info.messages = statistics.message_count
    info.first_ns, info.last_ns = statistics.message_start_time, statistics.message_end_time
    for number, count in statistics.channel_message_counts.items():
        if count:
            _count(info, file.channels[number], count)


def _read_all(info: FileInfo, file: RecordingFile, since_ns: int, until_ns: int) -> None:
    """Add the file's messages of this period to ``info``, which must have none."""
    for message in file.read(since_ns=since_ns, until_ns=until_ns):
        if since_ns <= message.log_ns < until_ns:  # `read` leaves out only whole chunks
            if not info.messages:
                info.first_ns = message.log_ns
            info.last_ns = message.log_ns
            info.messages += 1
            _count(info, message.channel, 1)


def _count(info: FileInfo, channel: Channel, count: int) -> None:
    info.topics[channel.topic] += count
    robot = robot_of(channel.topic)
    if robot is not None:
        info.robots.add(robot)


def events(paths: Iterable[Path]) -> Iterator[dict[str, Any]]:
    """Yield the recorder's own events (begin, gaps, drops), in the order of time."""
    for message in merged(paths, chooses=lambda channel: channel.topic == EVENTS):
        event = event_in(message.payload)
        if event.get("event") in _SHOWN_EVENTS:
            yield {**event, "t": message.log_ns // 10**6}


def event_in(payload: bytes) -> dict[str, Any]:
    """Return an event of the recorder; empty if the payload is none."""
    try:
        event = json.loads(payload)
    except (ValueError, RecursionError):
        return {}
    return event if isinstance(event, dict) else {}


@dataclass(frozen=True, slots=True)
class Query:
    """A selection of messages. Without conditions it selects all messages of robots, brokers and the recorder."""

    robot: str | None = None  # system/type/id
    topics: tuple[str, ...] = ()  # filters; one without the robot's identity begins at any robot's
    text: str | None = None  # somewhere in the payload

    def chooses(self, channel: Channel) -> bool:
        if self.robot is not None and not is_of(channel.topic, self.robot):
            return False
        return not self.topics or any(_matches(filter_, channel.topic) for filter_ in self.topics)

    def accepts(self, message: Recorded) -> bool:
        return self.text is None or self.text.encode() in message.payload


def check_names(query: Query, paths: Iterable[Path], places: Iterable[Path]) -> None:
    """Raise RecordingError if no recording of ``places`` has the robot or topic of the query: it may be mistyped.

    ``paths`` are the files there; the error names ``places``, as the user has named them.
    If a file cannot be read completely, its names are unknown; then nothing is raised, since the file's problem is
    reported.
    """
    if query.robot is None and not query.topics:
        return
    channels: list[Channel] = []
    for path in paths:
        try:
            with RecordingFile(path) as file:
                channels += file.channels.values()
                if file.problem:
                    return
        except RecordingError:
            return
    robots = robots_of(channels)
    names_as_typed = [composed(robot) for robot in robots]
    if query.robot is not None and query.robot not in names_as_typed:
        check_name("robot", query.robot, robots, places)
    topics = {channel.topic for channel in channels if query.robot is None or is_of(channel.topic, query.robot)}
    for filter_ in query.topics:
        if not any(_matches(filter_, topic) for topic in topics):
            of_robots = {topic for topic in topics if not topic.startswith("$")}  # not those of recorder and broker
            check_name("topic", filter_, of_robots, places)


def check_name(kind: str, name: str | None, known: Collection[str], places: Iterable[Path]) -> None:
    """Raise RecordingError, with the known names, if ``name`` is not among ``known``."""
    if name is not None and name not in known:
        listed = [shown(text) for text in sorted(known)[:_LISTED]] or ["none"]
        more = f" and {len(known) - _LISTED} more" if len(known) > _LISTED else ""
        where = ", ".join(map(str, places))
        raise RecordingError(f"no {kind} {shown(name)} in {where}; there are: {', '.join(listed)}{more}")


def _matches(filter_: str, topic: str) -> bool:
    has_robot = filter_.split("/", 1)[0] not in ("incoming", "outgoing")
    return matches(filter_ if has_robot else f"+/+/+/{filter_}", topic)
