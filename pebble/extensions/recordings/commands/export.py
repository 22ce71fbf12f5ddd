"""``pebble recordings`` export and import: recordings in the formats of other programs."""

from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import replace
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from pebble.config.visible import shown
from pebble.errors import PebbleError
from pebble.extensions.operator.client.names import base_of
from pebble.extensions.operator.commands import show
from pebble.extensions.recordings import catalogue
from pebble.extensions.recordings.catalogue import Query
from pebble.extensions.recordings.commands.options import RecordingsArgument, RobotOption, Since, Topics, Until, period
from pebble.extensions.recordings.commands.progress import progress_of_time
from pebble.extensions.recordings.commands.report import errors_of_files, report_unread
from pebble.extensions.recordings.exports.film import write_film, write_wav
from pebble.extensions.recordings.exports.foxglove import write_foxglove
from pebble.extensions.recordings.exports.lines import TRUNCATED, BadLine, read_lines, write_lines
from pebble.extensions.recordings.exports.unfinished import unfinished
from pebble.extensions.recordings.files.recorded import Recorded
from pebble.extensions.recordings.files.rewrite import Copy, write_copy
from pebble.extensions.recordings.files.writer import RecordingWriter
from pebble.extensions.recordings.library import Damages, files, merged, problems, reported


class Form(StrEnum):
    """The forms of exports."""

    LINES = "lines"
    FOXGLOVE = "foxglove"
    MKV = "mkv"
    MP4 = "mp4"
    WAV = "wav"
    MCAP = "mcap"


_BY_SUFFIX = {".jsonl": Form.LINES} | {f".{form}": form for form in (Form.MKV, Form.MP4, Form.WAV, Form.MCAP)}


def export(
    places: RecordingsArgument,
    target: Annotated[Path, typer.Argument(help="A new file.", metavar="OUT")],
    form: Annotated[Form | None, typer.Option("--as", help="What to write. [default: by the name of OUT]")] = None,
    robot: RobotOption = None,
    since: Since = None,
    until: Until = None,
    topic: Topics = None,
) -> int:
    """Export to JSON lines, Foxglove, a film, sound, MCAP."""
    form = form or _BY_SUFFIX.get(target.suffix)
    if form is None:
        raise PebbleError(f"{target}: what to write is not clear from this name: add --as lines, foxglove, mkv …")
    since_ns, until_ns = period(since, until)
    paths = files(places)
    query = Query(None if robot is None else base_of(robot), tuple(topic or ()))
    catalogue.check_names(query, paths, places)
    if query.robot is None and form in (Form.MKV, Form.MP4, Form.WAV):
        query = replace(query, robot=_only_robot(paths))
    damages = Damages()
    try:
        with progress_of_time(paths, since_ns, until_ns) as on_time:
            read = partial(merged, paths, since_ns=since_ns, until_ns=until_ns, chooses=query.chooses, damages=damages)
            typer.echo(_export(form, read, target, query.robot or "", on_time))
    finally:
        code = report_unread(problems(damages))
    return code


def import_(
    source: Annotated[Path, typer.Argument(help="JSON lines.", metavar="FILE")],
    target: Annotated[Path, typer.Argument(help="A new recording.", metavar="OUT.mcap")],
) -> int:
    """Import what the original's logger recorded, or an export as lines."""
    with (
        errors_of_files(source),
        source.open("rb") as file,
        unfinished(target) as path,
        path.open("wb", buffering=0) as out,
    ):
        writer = RecordingWriter(out)
        writer.metadata("pebble.recording", {"format": "1", "imported": source.name})
        counted = _import(read_lines(file), Copy(writer))
        writer.finish()
    typer.echo(f"{target}: {show.counted(counted['messages'], 'message')}")
    if counted["bad"]:
        typer.echo(f"pebble: {counted['bad']:,} lines hold no message and were left out", err=True)
    if counted["truncated"]:
        typer.echo(f"pebble: {counted['truncated']:,} payloads had been cut before", err=True)
    return 0 if counted["messages"] else 1


def _export(
    form: Form, read: Callable[[], Iterable[Recorded]], target: Path, robot: str, on_time: Callable[[int], None]
) -> str:
    """Write the export; return what it contains, in words."""
    if form in (Form.MKV, Form.MP4):
        film = write_film(read, target, robot, on_time=on_time)
        sound = "no sound" if film.sound is None else f"{show.duration(film.sound.seconds)} of sound"
        lost = f", {film.left_out:,} pictures that cannot be decoded left out" if film.left_out else ""
        return f"{target}: {show.duration(film.seconds)}, {film.pictures:,} pictures, {sound}{lost}"
    messages = reported(read(), on_time)
    if form is Form.FOXGLOVE:
        counts = write_foxglove(messages, target)
        return f"{target}: " + ", ".join(f"{count:,} {name}" for name, count in counts.items())
    if form is Form.WAV:
        return f"{target}: {show.duration(write_wav(messages, target, robot).seconds)} of sound"
    with unfinished(target) as path, path.open("wb") as out:
        count = write_lines(messages, out) if form is Form.LINES else write_copy(messages, out)
    return f"{target}: {show.counted(count, 'message')}"


def _import(lines: Iterable[Recorded | BadLine], copy: Copy) -> Counter[str]:
    """Add the messages of the lines to a recording; return the numbers of messages, bad lines and cut payloads."""
    counted = Counter[str]()
    for line in lines:
        if isinstance(line, BadLine):
            counted["bad"] += 1
            if counted["bad"] <= 3:
                typer.echo(f"pebble: line {line.number}: {shown(line.problem)}", err=True)
            continue
        copy.add(line)
        counted["messages"] += 1
        if TRUNCATED in line.channel.metadata:
            counted["truncated"] += 1
    return counted


def _only_robot(paths: list[Path]) -> str:
    robots = set[str]().union(*(catalogue.look_at(path).robots for path in paths))
    if len(robots) != 1:
        names = ", ".join(sorted(shown(robot) for robot in robots)) or "none"
        raise PebbleError(f"whose pictures and sound is not clear: add --robot ({names})")
    return robots.pop()
