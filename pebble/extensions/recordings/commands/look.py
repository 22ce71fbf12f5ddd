"""``pebble recordings`` list, info and search."""

from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated

import typer

from pebble.config.visible import shown
from pebble.extensions.operator.client.names import base_of
from pebble.extensions.operator.commands import show
from pebble.extensions.recordings import catalogue
from pebble.extensions.recordings.catalogue import FileInfo, Query
from pebble.extensions.recordings.commands.options import RecordingsArgument, RobotOption, Since, Topics, Until, period
from pebble.extensions.recordings.commands.progress import progress
from pebble.extensions.recordings.commands.report import local_time, one_line, report_unread
from pebble.extensions.recordings.files.recorded import RecordingError
from pebble.extensions.recordings.library import Damages, files, merged, problems, robot_of
from pebble.extensions.recordings.recorder.folder import MEDIA, NAME

_SHOWN_TOPICS = 30  # of one recording; the rest is counted
_ONE_LINE = 1 << 20  # columns
_CHECKED = 256 << 20  # bytes of files that are read as a whole without being asked to
Check = Annotated[bool, typer.Option("--check", help="Read all of it; without, of much only the summaries.")]


def list_(places: RecordingsArgument, since: Since = None, until: Until = None, check: Check = False) -> int:
    """List the files, their times, sizes and state."""
    rows, total = list[tuple[str, ...]](), Counter[str]()
    looked, unread = _looked_at(places, since, until, check=check)
    for info in looked:
        lasts = show.duration((info.last_ns - info.first_ns) / 1e9) if info.messages else ""
        begins = local_time(info.first_ns) if info.messages else ""
        messages = info.messages - info.notes
        rows.append((begins, lasts, _lane(info.path), f"{messages:,}", show.size(info.size), _state(info)))
        total.update(files=1, messages=messages, size=info.size)
    columns = ("begins", "lasts", "what", "messages", "size", "state")
    show.print_table(columns, rows, whole=("begins", "lasts"), right=("messages", "size"))
    files_, messages_ = show.counted(total["files"], "file"), show.counted(total["messages"], "message")
    typer.echo(f"{files_}, {messages_}, {show.size(total['size'])}")
    return report_unread(unread)


def info(places: RecordingsArgument, since: Since = None, until: Until = None, check: Check = False) -> int:
    """Show robots, topics, and what happened to the recording."""
    looked, unread = _looked_at(places, since, until, check=check, inside=True)
    topics = Counter[str]()
    for info in looked:
        topics.update(info.topics)
    notes, size = sum(info.notes for info in looked), sum(info.size for info in looked)
    messages = sum(info.messages for info in looked) - notes
    filled = [info for info in looked if info.messages]
    if filled:
        begin, end = min(info.first_ns for info in filled), max(info.last_ns for info in filled)
        typer.echo(f"{local_time(begin)} to {local_time(end)} ({show.duration((end - begin) / 1e9)})")
    also = f" and {show.counted(notes, 'note')} of the recorder" if notes else ""
    typer.echo(f"{show.counted(messages, 'message')}{also}, {show.size(size)} in {show.counted(len(looked), 'file')}")
    missing = sum(info.missing for info in looked)
    if missing:
        typer.echo(f"{show.counted(missing, 'message')} missing: files were damaged")
    for robot in sorted(set().union(*(info.robots for info in looked))):
        counts = Counter({topic[len(robot) + 1 :]: n for topic, n in topics.items() if robot_of(topic) == robot})
        typer.echo(f"\n{one_line(shown(robot))}: {show.counted(counts.total(), 'message')}")
        _print_topics(counts)
    no_robots = (topic for topic in topics if robot_of(topic) is None and not topic.startswith("$recorder/"))
    counts = Counter({topic: topics[topic] for topic in no_robots})
    if counts:
        typer.echo(f"\nTopics that are of no robot: {show.counted(counts.total(), 'message')}")
    _print_topics(counts)
    _print_events(info.path for info in looked if info.readable)
    return report_unread(unread)


def search(
    places: RecordingsArgument,
    robot: RobotOption = None,
    since: Since = None,
    until: Until = None,
    topic: Topics = None,
    text: Annotated[str | None, typer.Option(help="Somewhere in the payload.", metavar="TEXT")] = None,
    count: Annotated[int, typer.Option("--count", "-n", min=0, help="Stop after so many; 0: never.")] = 0,
) -> int:
    """Print the messages that match, in the order of time."""
    since_ns, until_ns = period(since, until)
    query = Query(None if robot is None else base_of(robot), tuple(topic or ()), text)
    paths, matches, damages = files(places), 0, Damages()
    catalogue.check_names(query, paths, places)
    for message in merged(paths, since_ns=since_ns, until_ns=until_ns, chooses=query.chooses, damages=damages):
        if not query.accepts(message):
            continue
        flag = " (retained)" if message.channel.metadata.get("retained") else ""
        line = one_line(show.body(message.payload, _ONE_LINE))
        topic_ = one_line(shown(message.channel.topic))
        typer.echo(f"{local_time(message.log_ns, fraction=True)}  {topic_}{flag}  {line}")
        matches += 1
        if matches == count:
            break
    typer.echo(show.counted(matches, "message"), err=True)
    return report_unread(problems(damages))


def _print_topics(counts: Counter[str]) -> None:
    for topic, number in counts.most_common(_SHOWN_TOPICS):
        typer.echo(f"  {number:>10,}  {one_line(shown(topic))}")
    if len(counts) > _SHOWN_TOPICS:
        typer.echo(f"  … and {len(counts) - _SHOWN_TOPICS} topics more")


def _looked_at(
    places: list[Path], since: str | None, until: str | None, *, check: bool, inside: bool = False
) -> tuple[list[FileInfo], list[str]]:
    """Return the files of a period in the order of time, and a line for each that cannot be read completely.

    Files are read completely with ``check``, or if that takes only seconds; otherwise their summaries count.
    ``inside``: count only messages of the period, for which files that reach beyond it are read.
    """
    since_ns, until_ns = period(since, until)
    counted_period = {"since_ns": since_ns, "until_ns": until_ns} if inside else {}
    paths = files(places)
    looked, unread = [], []
    size = sum(path.stat().st_size for path in paths if path.exists())
    with progress("reading", len(paths)) as advance:
        for number, path in enumerate(paths, 1):
            try:
                info = catalogue.look_at(path, whole=check or size <= _CHECKED, **counted_period)
            except RecordingError as error:
                if not path.exists():  # finished, renamed or deleted meanwhile
                    continue
                info = FileInfo(path, path.stat().st_size, readable=False)
                unread.append(str(error))
            if info.problem:
                unread.append(f"{path}: {info.problem}")
            # A file without messages has no times, and is in the list of any period.
            if info.first_ns < until_ns and (info.last_ns >= since_ns or not info.messages):
                looked.append(info)
            advance(number)
    if size > _CHECKED and not check:
        typer.echo(f"pebble: {show.size(size)} were not read but for their summaries: add --check", err=True)
    return sorted(looked, key=lambda info: (info.first_ns, info.path.name)), unread


def _lane(path: Path) -> str:
    """Return ``state`` or ``media of goob`` from the name of a recorder's file; any other name unchanged."""
    match = NAME.fullmatch(path.name)
    lane = match["lane"] if match else path.name
    return shown(f"media of {lane.rpartition('.')[2]}" if lane.startswith(MEDIA) else lane)


def _state(info: FileInfo) -> str:
    """Return the first of these states that is a file's; "" if it is finished and undamaged."""
    if info.is_active:
        return "being written"
    if info.missing:
        return f"{info.missing:,} missing"
    if not info.readable:
        return "cannot be read"
    if info.damaged or info.problem:
        return "damaged"
    return "" if info.finished else "unfinished"


def _print_events(paths: Iterable[Path]) -> None:
    # A recorder's events are in its files of states only.
    events = list(catalogue.events(path for path in paths if ".media." not in path.name))
    if events:
        typer.echo("\nWhat happened to the recording:")
    for event in events:
        name, at_ms = event.pop("event"), event.pop("t", 0)
        since_ms, until_ms = event.pop("since", None), event.pop("until", None)
        if isinstance(since_ms, int) and isinstance(until_ms, int):
            event["lasted"] = show.duration(max(0.0, (until_ms - since_ms) / 1e3))
        details = one_line(", ".join(f"{key} {value}" for key, value in event.items()))
        typer.echo(f"  {local_time(at_ms * 10**6)}  {shown(f'{name}: {details}')}")
