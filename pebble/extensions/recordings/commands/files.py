"""``pebble recordings`` mend and rm: repair and deletion of files."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pebble.config.visible import shown
from pebble.errors import PebbleError
from pebble.extensions.operator.client.names import base_of
from pebble.extensions.operator.commands import show
from pebble.extensions.recordings.catalogue import Query, check_names
from pebble.extensions.recordings.commands.options import RobotOption, Since, Until, period
from pebble.extensions.recordings.commands.progress import progress
from pebble.extensions.recordings.commands.report import errors_of_files, period_words, report_left, report_unread
from pebble.extensions.recordings.files.reader import RecordingFile
from pebble.extensions.recordings.files.recorded import Recorded, RecordingError, finished_path
from pebble.extensions.recordings.files.rewrite import Keeps, rewrite
from pebble.extensions.recordings.library import ACTIVE, FOREVER_NS, SUFFIX, files, is_of
from pebble.extensions.recordings.recorder.finisher import mend as mend_leftover
from pebble.extensions.recordings.recorder.folder import DAMAGED, Folder
from pebble.extensions.recordings.traffic.index import index_path
from pebble.runtime.as_owner import as_owner


def mend(
    source: Annotated[Path, typer.Argument(help="Folder of a recorder; or one file.", metavar="DIR|FILE")],
    target: Annotated[Path | None, typer.Argument(help="For a file: a new one.", metavar="OUT")] = None,
) -> int:
    """Copy what can be read of damaged or unfinished recordings.

    In a folder, finish the files that a killed recorder left, as the next recorder there would. If a file could not be
    read completely, the original is kept beside the copy, as ….mcap.damaged. FILE itself is not changed.
    """
    if not source.is_dir():
        return _mend_file(source, target)
    recordings = Folder(source)
    with as_owner(source), recordings.taken():
        return _mend_all(recordings)


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
    if robot is None and since is None and until is None:
        if folder.is_dir():
            raise PebbleError("what to delete is missing: name --robot, --since or --until")
        with as_owner(folder.parent), errors_of_files(folder):
            return _delete_whole(folder, yes=yes)
    since_ns, until_ns = period(since, until)
    base = None if robot is None else base_of(robot)

    def keeps(message: Recorded) -> bool:
        is_inside = since_ns <= message.log_ns < until_ns
        return not is_inside or (base is not None and not is_of(message.channel.topic, base))

    if not folder.is_dir():
        raise PebbleError(f"{folder}: there is no such folder")
    recordings = Folder(folder)
    # Locked, as a recorder there would write its retained values again.
    with as_owner(folder), recordings.taken(), errors_of_files(folder):
        return _rm(recordings, base, (since_ns, until_ns), keeps, yes=yes)


def _rm(recordings: Folder, base: str | None, period_ns: tuple[int, int], keeps: Keeps, *, yes: bool) -> int:
    """Delete what ``keeps`` does not accept from a recorder's files, which must be locked; return the exit code."""
    finished, unsure = list[Path](), 0  # unsure: files that stay, and may hold something to delete
    for entry in recordings.entries():
        if entry.is_finished:
            finished.append(entry.path)
        else:
            report_left(f"{entry.path}: is not finished, or damaged")
            unsure += 1
    if not unsure:  # else the robot may be in a file that was not read
        check_names(Query(base), finished, [recordings.root])
    due = [path for path in finished if _reaches_into(path, *period_ns)]
    what = f"{shown(base)} " if base else "everything "
    if period_ns != (0, FOREVER_NS):
        typer.echo(f"{what}{period_words(*period_ns)}")
    if not yes and not typer.confirm(f"Delete {what}from {show.counted(len(due), 'file')} in {recordings.root}?"):
        return 1
    deleted = 0
    with progress("deleting", len(due)) as advance:
        for number, path in enumerate(due, 1):
            try:
                copy = rewrite(path, path, keeps=keeps)
            except (PebbleError, OSError) as error:
                report_left(error)
                unsure += 1
                continue
            if copy.left_out:
                deleted += copy.left_out
                index_path(path).unlink(missing_ok=True)
                if not copy.messages:
                    path.unlink()
            advance(number)
    typer.echo(f"{show.counted(deleted, 'message')} deleted")
    if unsure:
        typer.echo(
            f"pebble: {unsure} files may hold more of it: pebble recordings rm FILE deletes one as a whole", err=True
        )
    return 1 if unsure else 0


def _reaches_into(path: Path, since_ns: int, until_ns: int) -> bool:
    """True if a file may hold messages of a period; an unreadable file may."""
    try:
        with RecordingFile(path) as file:
            return not file.chunks or file.reaches_into(since_ns, until_ns)
    except RecordingError:
        return True


def _delete_whole(path: Path, *, yes: bool) -> int:
    """Delete a whole file. Raises PebbleError for a file that no recorder wrote, or that is not finished."""
    if path.is_symlink():
        raise PebbleError(f"{path} is a link: name the file itself")
    if path.name.endswith(ACTIVE):
        raise PebbleError(f"{path}: is being written, or left by a recorder: pebble recordings mend DIR finishes it")
    if not path.is_file() or not path.name.endswith((SUFFIX, DAMAGED)):
        raise PebbleError(f"{path}: there is no such folder or recording")
    if not yes and not typer.confirm(f"Delete {path}?"):
        return 1
    path.unlink()
    index_path(path).unlink(missing_ok=True)
    typer.echo(f"{path.name}: deleted")
    return 0


def _mend_file(source: Path, target: Path | None) -> int:
    files([source])  # raises an error if it is no recording
    if target is None:
        raise PebbleError(f"{source}: name a new file for what can be read: pebble recordings mend {source} OUT")
    if target.exists():
        raise PebbleError(f"{target} exists already")
    with as_owner(target.parent), errors_of_files(target):
        copy = rewrite(source, target)
    typer.echo(f"{target}: {show.counted(copy.messages, 'message')}, {copy.missing:,} missing")
    report_unread([f"{source}: {copy.unread}"] if copy.unread else [])
    return 0 if copy.messages else 1


def _mend_all(folder: Folder) -> int:
    """Finish the files that a killed recorder left; return the exit code."""
    # The caller holds the folder's lock: what is active was left by a killed recorder.
    unfinished, failed = [entry.path for entry in folder.entries() if entry.is_active], False
    for path in unfinished:
        try:
            copy = mend_leftover(path)
        except (PebbleError, OSError) as error:
            report_left(f"{path.name}: {error}")
            failed = True
            continue
        failed = failed or not copy.is_whole
        typer.echo(f"{finished_path(path).name}: {show.counted(copy.messages, 'message')}, {copy.missing:,} missing")
    if not unfinished:
        typer.echo("nothing to mend")
    return 1 if failed else 0
