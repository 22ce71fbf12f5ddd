"""One stream of messages, in the order of time, from any number of recordings."""

from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path

from pebble.contract.identity import composed, parse_topic
from pebble.extensions.recordings.files.reader import Chooses, RecordingFile, in_time_order
from pebble.extensions.recordings.files.recorded import ACTIVE as ACTIVE
from pebble.extensions.recordings.files.recorded import FOREVER_NS as FOREVER_NS
from pebble.extensions.recordings.files.recorded import SUFFIX as SUFFIX
from pebble.extensions.recordings.files.recorded import Channel, Damage, Recorded, RecordingError, present_path
from pebble.extensions.recordings.files.records import MAGIC
from pebble.ownership import open_plain

#: The damage of each file that was read.
Damages = dict[Path, Damage]


def files(places: Iterable[Path]) -> list[Path]:
    """Return the recordings among ``places`` and in folders there, finished or not.

    Raises RecordingError if there are none.
    """
    paths: list[Path] = []
    for place in places:
        if place.is_dir():
            paths += sorted(recordings_in(place))
        elif _begins_as_mcap(place) or place.name.endswith((SUFFIX, ACTIVE)):
            paths.append(place)
        else:
            raise RecordingError(f"{place}: is not a recording (MCAP)")
    if not paths:
        raise RecordingError(f"{', '.join(map(str, places))}: there is no recording")
    return paths


def recordings_in(folder: Path) -> Iterator[Path]:
    """Yield the recordings of a folder by name; a broken link counts as an unreadable recording."""
    for path in folder.rglob(f"*{SUFFIX}*"):
        if path.name.endswith((SUFFIX, ACTIVE)) and (path.is_file() or path.is_symlink()):
            yield path


def merged(
    paths: Iterable[Path],
    *,
    since_ns: int = 0,
    until_ns: int = FOREVER_NS,
    chooses: Chooses = lambda _channel: True,
    damages: Damages | None = None,
) -> Iterator[Recorded]:
    """Yield the messages of all files from ``since_ns`` to before ``until_ns``, in the order of their arrival.

    A file is open only while its messages are due; chunks outside the period are not decompressed. Damage of the read
    parts is put into ``damages``. Raises RecordingError.
    """
    damages = {} if damages is None else damages
    due = []
    for path in paths:
        with RecordingFile(path) as file:
            if not file.chunks:
                damages[path] = file.damage
            elif file.reaches_into(since_ns, until_ns):
                reading = partial(_messages, path, since_ns, until_ns, chooses, damages)
                due.append((max(file.first_ns, since_ns), reading))
    yield from in_time_order(due)


def reported(messages: Iterable[Recorded], on_time: Callable[[int], None]) -> Iterator[Recorded]:
    """Yield the messages; call ``on_time`` with the log time of each."""
    for message in messages:
        on_time(message.log_ns)
        yield message


def problems(damages: Damages) -> list[str]:
    """Return a line for each file that could not be read completely."""
    reports = ((path, damage.report(active=path.name.endswith(ACTIVE))) for path, damage in damages.items())
    return [f"{path}: {text}" for path, text in reports if text]


def _messages(path: Path, since_ns: int, until_ns: int, chooses: Chooses, damages: Damages) -> Iterator[Recorded]:
    present = present_path(path)
    if present is None:  # deleted meanwhile, to make room
        return
    with RecordingFile(present) as file:
        damages[present] = file.damage
        for message in file.read(chooses=chooses, since_ns=since_ns, until_ns=until_ns):
            if since_ns <= message.log_ns < until_ns:  # `read` leaves out only whole chunks
                yield message


def _begins_as_mcap(path: Path) -> bool:
    try:
        with open_plain(path) as file:
            return file.read(len(MAGIC)) == MAGIC
    except OSError as error:
        raise RecordingError(f"{path}: {error.strerror or error}") from None


def robot_of(topic: str) -> str | None:
    """Return ``system/type/id`` of a topic; None if it has none."""
    parsed = parse_topic(topic)
    return None if parsed is None else parsed.identity.base


def is_of(topic: str, base: str | None) -> bool:
    """True if a topic is of the robot that a user calls ``base``; its own name may spell accents otherwise."""
    robot = robot_of(topic)
    return robot is not None and composed(robot) == base


def robots_of(channels: Iterable[Channel]) -> set[str]:
    """Return the robots in the channels' topics."""
    return {robot for robot in (robot_of(channel.topic) for channel in channels) if robot is not None}
