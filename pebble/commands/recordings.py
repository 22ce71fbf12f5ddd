"""``pebble recordings``: lists, searches, mends, exports and deletes recordings."""

from __future__ import annotations

import sys
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, BinaryIO

import typer
from rich import box
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn
from rich.table import Table

from pebble.client.names import base_of
from pebble.commands import show
from pebble.config.visible import shown
from pebble.errors import PebbleError
from pebble.recordings import catalogue
from pebble.recordings.catalogue import FileInfo, Query
from pebble.recordings.exports.copy import write_copy
from pebble.recordings.exports.film import write_film, write_wav
from pebble.recordings.exports.foxglove import write_foxglove
from pebble.recordings.exports.lines import BadLine, Imported, read_lines, write_lines
from pebble.recordings.exports.mongo import read_mongo, write_mongo
from pebble.recordings.exports.unfinished import unfinished
from pebble.recordings.files.finish import finish as finish_file
from pebble.recordings.files.mcap import Recorded, RecordingError
from pebble.recordings.files.rewrite import rewrite
from pebble.recordings.files.scan import Damage
from pebble.recordings.files.writer import LIBRARY, McapWriter
from pebble.recordings.library import (
    ACTIVE,
    FOREVER_NS,
    SUFFIX,
    Damages,
    files,
    merged,
    problems,
    robot_in,
    robot_of,
    span,
)
from pebble.recordings.period import SINCE_HELP, UNTIL_HELP, parse_period
from pebble.recordings.recorder.folder import DAMAGED, Folder, finished_path, rename
from pebble.recordings.stamps import stamp_ns
from pebble.recordings.traffic.index import Index, archive_of, not_indexed

_QUIET_S = 2.0  # before progress is shown
_SHOWN_TOPICS = 30
_ONE_LINE = 1 << 20  # columns
_CHECKED = 256 << 20  # bytes of files that are read as a whole without being asked to

Places = Annotated[list[Path], typer.Argument(help="Recordings, or folders of them.", metavar="DIR|FILE…")]
Since = Annotated[str | None, typer.Option(help=SINCE_HELP, metavar="TIME")]
Until = Annotated[str | None, typer.Option(help=UNTIL_HELP, metavar="TIME")]
RobotOption = Annotated[
    str | None, typer.Option("--robot", "-r", help="Only this one.", metavar="[SYSTEM/TYPE/]ID", show_default=False)
]
Check = Annotated[bool, typer.Option("--check", help="Read all of it; without, of much only the summaries.")]
Topics = Annotated[
    list[str] | None,
    typer.Option(
        "--topic", "-t", help="outgoing/logs, or a whole topic; + and # allowed; repeatable.", metavar="FILTER"
    ),
]

_HELP = """List, search, mend, export and delete recordings.

\b
    pebble recordings list DIR
    pebble recordings info DIR --since 10:00
    pebble recordings search DIR --robot goob -t outgoing/logs --text WARN
    pebble recordings export DIR walk.mkv -r goob --since 10:00 --until +5m
    pebble recordings finish DIR     after a power cut, without a recorder
"""


class Form(StrEnum):
    """What recordings can be exported to."""

    LINES = "lines"
    MONGO = "mongo"
    FOXGLOVE = "foxglove"
    MKV = "mkv"
    MP4 = "mp4"
    WAV = "wav"
    MCAP = "mcap"


_BY_SUFFIX = {
    ".jsonl": Form.LINES,
    ".bson": Form.MONGO,
    ".mkv": Form.MKV,
    ".mp4": Form.MP4,
    ".wav": Form.WAV,
    ".mcap": Form.MCAP,
}


def register(app: typer.Typer) -> None:
    group = typer.Typer(help=_HELP, rich_markup_mode=None)
    for command in (list_, info, search, finish, recover, compact, index, export, import_, rm):
        group.command(command.__name__.rstrip("_"))(command)
    app.add_typer(group, name="recordings")


def list_(places: Places, since: Since = None, until: Until = None, check: Check = False) -> int:
    """List the files, their times, sizes and state."""
    table = Table(*_columns("begins", "lasts", "what", "messages", "size", "state"), box=box.SIMPLE, pad_edge=False)
    total = Counter[str]()
    looked, unread = _looked_at(places, since, until, check=check)
    for one in looked:
        lasts = show.duration((one.last_ns - one.first_ns) / 1e9) if one.messages else ""
        begins = _local(one.first_ns) if one.messages else ""
        table.add_row(begins, lasts, _lane(one.path), f"{one.messages:,}", show.size(one.size), _state(one))
        total.update(files=1, messages=one.messages, size=one.size)
    _console().print(table)
    typer.echo(f"{total['files']} files, {total['messages']:,} messages, {show.size(total['size'])}")
    return _report_unread(unread)


def info(places: Places, since: Since = None, until: Until = None, check: Check = False) -> int:
    """Show robots, topics, and what happened to the recording."""
    looked, unread = _looked_at(places, since, until, check=check)
    topics, sizes = Counter[str](), sum(one.size for one in looked)
    for one in looked:
        topics.update(one.topics)
    messages = sum(one.messages for one in looked)
    times = [one for one in looked if one.messages]
    if times:
        begin, end = min(one.first_ns for one in times), max(one.last_ns for one in times)
        typer.echo(f"{_local(begin)} to {_local(end)} ({show.duration((end - begin) / 1e9)})")
    typer.echo(f"{messages:,} messages, {show.size(sizes)} in {len(looked)} files")
    missing = sum(one.missing for one in looked)
    if missing:
        typer.echo(f"{missing:,} messages are missing: files were damaged")
    for robot in sorted(set().union(*(one.robots for one in looked))):
        count = sum(number for topic, number in topics.items() if topic.startswith(f"{robot}/"))
        typer.echo(f"\n{_one_line(shown(robot))}: {count:,} messages")
        own = Counter({topic[len(robot) + 1 :]: n for topic, n in topics.items() if topic.startswith(f"{robot}/")})
        for topic, number in own.most_common(_SHOWN_TOPICS):
            typer.echo(f"  {number:>10,}  {_one_line(shown(topic))}")
        if len(own) > _SHOWN_TOPICS:
            typer.echo(f"  … and {len(own) - _SHOWN_TOPICS} topics more")
    encodings = {topic: name for one in looked for topic, name in one.encodings.items() if robot_in(topic) is None}
    others = Counter({topic: topics[topic] for topic in encodings if not topic.startswith("$recorder/")})
    if others:
        typer.echo(f"\nTopics that are of no robot: {others.total():,} messages")
    for topic, number in others.most_common(_SHOWN_TOPICS):
        typer.echo(f"  {number:>10,}  {_one_line(shown(f'{topic} {encodings[topic]}'))}")
    if len(others) > _SHOWN_TOPICS:
        typer.echo(f"  … and {len(others) - _SHOWN_TOPICS} topics more")
    _print_events(one.path for one in looked if one.readable)
    return _report_unread(unread)


def search(
    places: Places,
    robot: RobotOption = None,
    since: Since = None,
    until: Until = None,
    topic: Topics = None,
    text: Annotated[str | None, typer.Option(help="Somewhere in the payload.", metavar="TEXT")] = None,
    count: Annotated[int, typer.Option("--count", "-n", min=0, help="Stop after so many; 0: never.")] = 0,
) -> int:
    """Print the messages that match, in the order of time."""
    since_ns, until_ns = _period(since, until)
    query = Query(None if robot is None else base_of(robot), tuple(topic or ()), text)
    found, damages = 0, Damages()
    for message in merged(files(places), since_ns=since_ns, until_ns=until_ns, chooses=query.chooses, damages=damages):
        if not query.accepts(message):
            continue
        flag = " (retained)" if message.channel.metadata.get("retained") else ""
        line = _one_line(show.body(message.payload, _ONE_LINE))
        topic_ = _one_line(shown(message.channel.topic))
        typer.echo(f"{_local(message.log_ns, fraction=True)}  {topic_}{flag}  {line}")
        found += 1
        if found == count:
            break
    typer.echo(f"{found:,} messages", err=True)
    return _report_unread(problems(damages))


def finish(folder: Annotated[Path, typer.Argument(help="Folder of a recorder.", metavar="DIR")]) -> int:
    """Finish what a killed recorder left; the next one there does it, too."""
    owner = Folder(_existing(folder))
    try:
        owner.take()
    except RecordingError as error:
        raise PebbleError(f"{folder}: a recorder writes here, and finishes them itself") from error
    try:
        return _finish_all(owner)
    finally:
        owner.release()


def recover(
    source: Annotated[Path, typer.Argument(help="A damaged recording; it stays as it is.", metavar="FILE")],
    target: Annotated[Path, typer.Argument(help="A new file.", metavar="OUT")],
) -> int:
    """Copy what can be read of a recording into a new file."""
    files([source])
    if target.exists():
        raise PebbleError(f"{target} exists already")
    made = rewrite(source, target)
    typer.echo(f"{target}: {made.messages:,} messages, {made.missing:,} missing")
    if made.unread:
        typer.echo(f"pebble: {source}: {shown(made.unread)}", err=True)
    return 0 if made.messages else 1


def compact(folder: Annotated[Path, typer.Argument(help="Folder of a recorder.", metavar="DIR")]) -> int:
    """Write files again in larger pieces, which are smaller."""
    before = after = left = 0
    owner = Folder(_existing(folder))
    with owner.maintained():
        entries = [entry for entry in owner.entries() if entry.is_finished]
        with _progress("compacting", len(entries)) as advance:
            for number, entry in enumerate(entries, 1):
                try:
                    made = rewrite(entry.path, entry.path)
                except (PebbleError, OSError) as error:
                    left += _report_left(error)
                    continue
                before, after = before + entry.size, after + made.size
                advance(number)
    typer.echo(f"{show.size(before)} became {show.size(after)}")
    return 1 if left else 0


def index(folder: Annotated[Path, typer.Argument(help="Folder of a recorder.", metavar="DIR")]) -> int:
    """Index recordings for `pebble analyse`, as Parquet files."""
    from pebble.recordings.traffic.duck import require_packages

    require_packages("duckdb", "matplotlib")
    due, unread = not_indexed(folder), []
    with _progress("indexing", len(due)) as advance:
        for number, path in enumerate(due, 1):
            entry = Index(folder).add(path)
            if entry.unread:
                unread.append(f"{path}: {entry.unread}")
            advance(number)
    typer.echo(f"{len(due)} recordings indexed")
    return _report_unread(unread)


def export(
    places: Places,
    target: Annotated[Path, typer.Argument(help="A new file.", metavar="OUT")],
    form: Annotated[Form | None, typer.Option("--as", help="What to write. [default: by the name of OUT]")] = None,
    robot: RobotOption = None,
    since: Since = None,
    until: Until = None,
    topic: Topics = None,
) -> int:
    """Export to JSON lines, MongoDB, Foxglove, a film, MCAP."""
    form = form or _BY_SUFFIX.get(target.suffix)
    if form is None:
        raise PebbleError(f"{target}: what to write is not clear from this name: add --as lines, foxglove, mkv …")
    since_ns, until_ns = _period(since, until)
    paths = files(places)
    base = None if robot is None else base_of(robot)
    if form in (Form.MKV, Form.MP4, Form.WAV):
        base = base or _only_robot(paths)
    query = Query(base, tuple(topic or ()))
    damages = Damages()
    beside = damages if query == Query() else ()  # those that were read
    try:
        with _progress_of_time(paths, since_ns, until_ns) as on_time:
            messages = merged(paths, since_ns=since_ns, until_ns=until_ns, chooses=query.chooses, damages=damages)
            typer.echo(_export(form, messages, target, base or "", on_time, beside))
    finally:
        code = _report_unread(problems(damages))
    return code


def import_(
    source: Annotated[Path, typer.Argument(help="logger.jsonl, or messages.bson of mongodump.", metavar="FILE")],
    target: Annotated[Path, typer.Argument(help="A new recording.", metavar="OUT.mcap")],
) -> int:
    """Import what the original's logger or MongoDB recorded."""
    with _opened(source) as file, unfinished(target, overwrite=False) as path, path.open("wb", buffering=0) as out:
        writer = McapWriter(out, library=LIBRARY)
        writer.metadata("pebble.recording", {"format": "1", "imported": source.name})
        read = read_mongo if ".bson" in source.name else read_lines
        counted = _import(read(file), writer)
        writer.finish()
    typer.echo(f"{target}: {counted['messages']:,} messages")
    if counted["bad"]:
        typer.echo(f"pebble: {counted['bad']:,} lines hold no message and were left out", err=True)
    if counted["truncated"]:
        typer.echo(f"pebble: {counted['truncated']:,} payloads had been cut before", err=True)
    return 0 if counted["messages"] else 1


def rm(
    folder: Annotated[
        Path, typer.Argument(help="Folder of a recorder; or one file, which goes as a whole.", metavar="DIR|FILE")
    ],
    robot: RobotOption = None,
    since: Since = None,
    until: Until = None,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask.")] = False,
) -> int:
    """Delete what was recorded of a robot, or in a period. Files that hold more are written again without it.

    A file that cannot be read completely stays as it is. One that is named is deleted, whatever is in it.
    """
    if not folder.is_dir() and robot is None and since is None and until is None:
        return _delete_whole(folder, yes=yes)
    if robot is None and since is None and until is None:
        raise PebbleError("what to delete is missing: name --robot, --since or --until")
    since_ns, until_ns = _period(since, until)
    base = None if robot is None else base_of(robot)

    def keeps(message: Recorded) -> bool:
        inside = since_ns <= message.log_ns < until_ns
        return not inside or (base is not None and robot_of(message.channel) != base)

    if Folder.is_in_use(_existing(folder)):
        raise PebbleError(f"{folder}: a recorder writes here, and would write retained values again: stop it first")
    entries = Folder(folder).entries()
    left = sum(_report_left(f"{entry.path}: is not finished, or damaged") for entry in entries if not entry.is_finished)
    due = [entry.path for entry in entries if entry.is_finished and _reaches_into(entry.path, since_ns, until_ns)]
    what = f"{shown(base)} " if base else "everything "
    if not yes and not typer.confirm(f"Delete {what}from {len(due)} files in {folder}?"):
        return 1
    deleted = 0
    with Folder(folder).maintained(), _progress("deleting", len(due)) as advance:
        for number, path in enumerate(due, 1):
            try:
                names = path.stat().st_nlink
                made = rewrite(path, path, keeps=keeps)
            except (PebbleError, OSError) as error:
                left += _report_left(error)
                continue
            if made.left_out:
                deleted += made.left_out
                if names > 1:
                    left += 1
                    typer.echo(f"pebble: {path}: has other names (hard links), which keep all of it", err=True)
                Index(folder).remove(path)
                if made.is_empty:
                    path.unlink()
            advance(number)
    typer.echo(f"{deleted:,} messages deleted")
    if left:
        typer.echo(
            f"pebble: {left} files may hold more of it: pebble recordings rm FILE deletes one as a whole", err=True
        )
    return 1 if left else 0


def _reaches_into(path: Path, since_ns: int, until_ns: int) -> bool:
    """Whether a file may hold messages of a period: one that cannot be read may."""
    damage = Damage()
    try:
        one = span(path, damage)
    except RecordingError:
        return True
    return damage.unread if one is None else one.last_ns >= since_ns and one.first_ns < until_ns


def _delete_whole(path: Path, *, yes: bool) -> int:
    """Raises PebbleError for what is no file of a recorder, or is being written."""
    if path.is_symlink():
        raise PebbleError(f"{path} is a link: name the file itself")
    if not path.is_file() or not path.name.endswith((SUFFIX, ACTIVE, DAMAGED)):
        raise PebbleError(f"{path}: there is no such folder or recording")
    archive = archive_of(path.parent)
    if path.name.endswith(ACTIVE) and Folder.is_in_use(archive):
        raise PebbleError(f"{path}: is being written: stop the recorder first")
    if not yes and not typer.confirm(f"Delete {path}?"):
        return 1
    path.unlink()
    Index(archive).remove(path)
    typer.echo(f"{path.name}: deleted")
    return 0


def _report_left(error: object) -> int:
    typer.echo(f"pebble: left as it is: {shown(str(error))}", err=True)
    return 1


def _report_unread(lines: list[str]) -> int:
    """The exit code: 1 if there is a line."""
    for line in lines:
        typer.echo(f"pebble: {shown(line)}", err=True)
    return 1 if lines else 0


def _finish_all(folder: Folder) -> int:
    left = [entry.path for entry in folder.entries() if entry.is_active]
    failed = 0
    for path in left:
        try:
            made = finish_file(path)
            rename(path, finished_path(path))
        except (PebbleError, OSError) as error:
            typer.echo(f"pebble: {path.name}: {shown(str(error))}", err=True)
            failed += 1
            continue
        lost = f", {made.missing:,} missing" if made.missing else ""
        lost += f", {made.damaged_bytes:,} damaged bytes" if made.damaged_bytes else ""
        failed += bool(lost)
        typer.echo(f"{finished_path(path).name}: {made.messages:,} messages{lost}")
    if not left:
        typer.echo("nothing to finish")
    return 1 if failed else 0


def _existing(folder: Path) -> Path:
    if not folder.is_dir():
        raise PebbleError(f"{folder}: there is no such folder")
    return folder


def _columns(*names: str) -> Iterator[Any]:
    from rich.table import Column

    for name in names:
        yield Column(name, justify="right" if name in ("messages", "size") else "left")


def _looked_at(
    places: list[Path], since: str | None, until: str | None, *, check: bool
) -> tuple[list[FileInfo], list[str]]:
    """The files of a period by their times, and a line for each that cannot be read completely.

    They are read as a whole with ``check``, or if that takes no more than seconds; else their summaries count.
    """
    since_ns, until_ns = _period(since, until)
    paths = files(places)
    looked, unread = [], []
    size = sum(path.stat().st_size for path in paths if path.exists())
    with _progress("reading", len(paths)) as advance:
        for number, path in enumerate(paths, 1):
            try:
                one = catalogue.look_at(path, whole=check or size <= _CHECKED)
            except RecordingError as error:
                if not path.exists():  # finished, renamed or deleted meanwhile
                    continue
                one = FileInfo(path, path.stat().st_size, readable=False)
                unread.append(str(error))
            if one.problem:
                unread.append(f"{path}: {one.problem}")
            if one.first_ns < until_ns and (one.last_ns >= since_ns or not one.messages):
                looked.append(one)
            advance(number)
    if size > _CHECKED and not check:
        typer.echo(f"pebble: {show.size(size)} were not read but for their summaries: add --check", err=True)
    return sorted(looked, key=lambda one: (one.first_ns, one.path.name)), unread


def _lane(path: Path) -> str:
    """``state`` or ``media of goob``, from the name of a recorder's file; else that name."""
    parts = path.name.removesuffix(".active").removesuffix(".mcap").split(".", 1)
    if len(parts) == 1:
        return shown(path.name)
    return shown(f"media of {parts[1].rpartition('.')[2]}" if parts[1].startswith("media.") else parts[1])


def _state(one: FileInfo) -> str:
    if one.is_active:
        return "being written"
    if one.missing:
        return f"{one.missing:,} missing"
    if not one.readable:
        return "cannot be read"
    return "damaged" if one.damaged or one.problem else "" if one.finished else "unfinished"


def _print_events(paths: Iterable[Path]) -> None:
    found = list(catalogue.events(path for path in paths if ".media." not in path.name))
    if found:
        typer.echo("\nWhat happened to the recording:")
    for event in found:
        name, at = event.pop("event"), event.pop("t", 0)
        since, until = event.pop("since", None), event.pop("until", None)
        if isinstance(since, int) and isinstance(until, int):
            event["lasted"] = show.duration(max(0.0, (until - since) / 1e3))
        details = _one_line(", ".join(f"{key} {value}" for key, value in event.items()))
        typer.echo(f"  {_local(at * 10**6)}  {shown(f'{name}: {details}')}")


def _export(
    form: Form,
    messages: Iterable[Recorded],
    target: Path,
    robot: str,
    on_time: Callable[[int], None],
    beside: Iterable[Path],
) -> str:
    if form is Form.FOXGLOVE:
        counts = write_foxglove(messages, target, on_time=on_time)
        return f"{target}: " + ", ".join(f"{count:,} {name}" for name, count in counts.items())
    if form in (Form.MKV, Form.MP4):
        film = write_film(messages, target, robot, on_time=on_time)
        sound = "no sound" if film.sound is None else f"{show.duration(film.sound.seconds)} of sound"
        return f"{target}: {show.duration(film.seconds)}, {film.pictures:,} pictures, {sound}"
    if form is Form.WAV:
        return f"{target}: {show.duration(write_wav(messages, target, robot, on_time=on_time).seconds)} of sound"
    with unfinished(target, overwrite=False) as path, path.open("wb") as out:
        if form is Form.LINES:
            count = write_lines(messages, out, on_time=on_time)
        elif form is Form.MONGO:
            count = write_mongo(messages, out, on_time=on_time)
        else:
            count = write_copy(messages, out, on_time=on_time, beside=beside)
    return f"{target}: {count:,} messages"


def _import(found: Iterable[Imported | BadLine], writer: McapWriter) -> Counter[str]:
    counted = Counter[str]()
    channels: dict[tuple[str, str, tuple[tuple[str, str], ...]], int] = {}
    for one in found:
        if isinstance(one, BadLine):
            counted["bad"] += 1
            if counted["bad"] <= 3:
                typer.echo(f"pebble: line {one.number}: {shown(one.problem)}", err=True)
            continue
        encoding = "json" if one.payload[:1] in (b"{", b"[") else "application/octet-stream"
        key = (one.topic, encoding, tuple(one.metadata.items()))
        if key not in channels:
            channels[key] = writer.channel(one.topic, encoding, one.metadata)
        writer.add(channels[key], one.log_ns, one.payload, stamp_ns(one.payload))
        counted["messages"] += 1
        counted["truncated"] += one.truncated
    return counted


def _only_robot(paths: list[Path]) -> str:
    robots = set[str]().union(*(catalogue.look_at(path).robots for path in paths))
    if len(robots) != 1:
        names = ", ".join(sorted(shown(robot) for robot in robots)) or "none"
        raise PebbleError(f"whose pictures and sound is not clear: add --robot ({names})")
    return robots.pop()


@contextmanager
def _opened(path: Path) -> Iterator[BinaryIO]:
    try:
        with path.open("rb") as file:
            yield file
    except OSError as error:
        raise PebbleError(f"{path}: {error.strerror or error}") from None


def _period(since: str | None, until: str | None) -> tuple[int, int]:
    return parse_period(since, until, now=datetime.now().astimezone())


def _one_line(text: str) -> str:
    return " ".join(text.split("\n")).replace("\t", " ")


def _local(ns: int, *, fraction: bool = False) -> str:
    moment = datetime.fromtimestamp(ns / 1e9, UTC).astimezone()
    text = moment.strftime("%Y-%m-%d %H:%M:%S")
    return f"{text}.{ns // 10**6 % 1000:03d}" if fraction else text


def _console() -> Console:
    return Console(highlight=False, markup=False)


@contextmanager
def _progress(what: str, total: int) -> Iterator[Callable[[float], None]]:
    """Shown on a terminal, and only where it takes longer than two seconds."""
    began, bar = time.monotonic(), None
    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
    progress = Progress(*columns, console=Console(stderr=True), transient=True)

    def advance(done: float) -> None:
        nonlocal bar
        if bar is None and sys.stderr.isatty() and time.monotonic() - began > _QUIET_S:
            progress.start()
            bar = progress.add_task(what, total=total)
        if bar is not None:
            progress.update(bar, completed=done)

    try:
        yield advance
    finally:
        if bar is not None:
            progress.stop()


@contextmanager
def _progress_of_time(paths: list[Path], since_ns: int, until_ns: int) -> Iterator[Callable[[int], None]]:
    spans = [one for path in paths if (one := span(path)) is not None]
    begin = max(since_ns, min((one.first_ns for one in spans), default=0))
    end = min(until_ns, max((one.last_ns for one in spans if one.last_ns != FOREVER_NS), default=begin + 1))
    with _progress("exporting", max(1, end - begin)) as advance:
        yield lambda log_ns: advance(log_ns - begin)
