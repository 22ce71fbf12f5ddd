"""``pebble recordings`` finish, recover, compact, index and rm: what is done to the files themselves."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pebble.client.names import base_of
from pebble.commands.recordings.options import RobotOption, Since, Until, period
from pebble.commands.recordings.progress import progress
from pebble.commands.recordings.report import report_left, report_unread
from pebble.commands.terminal import show
from pebble.config.visible import shown
from pebble.errors import PebbleError
from pebble.recordings.catalogue import Query, check_names
from pebble.recordings.files.finish import finish as finish_file
from pebble.recordings.files.mcap import Recorded, RecordingError
from pebble.recordings.files.rewrite import rewrite
from pebble.recordings.files.scan import Damage
from pebble.recordings.library import ACTIVE, SUFFIX, files, robot_of, span
from pebble.recordings.recorder.folder import DAMAGED, Folder, finished_path, rename
from pebble.recordings.traffic.index import Index, archive_of, not_indexed


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
        with progress("compacting", len(entries)) as advance:
            for number, entry in enumerate(entries, 1):
                try:
                    made = rewrite(entry.path, entry.path)
                except (PebbleError, OSError) as error:
                    left += report_left(error)
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
    with progress("indexing", len(due)) as advance:
        for number, path in enumerate(due, 1):
            entry = Index(folder).add(path)
            if entry.unread:
                unread.append(f"{path}: {entry.unread}")
            advance(number)
    typer.echo(f"{len(due)} recordings indexed")
    return report_unread(unread)


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
    since_ns, until_ns = period(since, until)
    base = None if robot is None else base_of(robot)

    def keeps(message: Recorded) -> bool:
        inside = since_ns <= message.log_ns < until_ns
        return not inside or (base is not None and robot_of(message.channel) != base)

    if Folder.is_in_use(_existing(folder)):
        raise PebbleError(f"{folder}: a recorder writes here, and would write retained values again: stop it first")
    entries = Folder(folder).entries()
    left = sum(report_left(f"{entry.path}: is not finished, or damaged") for entry in entries if not entry.is_finished)
    finished = [entry.path for entry in entries if entry.is_finished]
    if not left:
        check_names(Query(base), finished, [folder])
    due = [path for path in finished if _reaches_into(path, since_ns, until_ns)]
    what = f"{shown(base)} " if base else "everything "
    if not yes and not typer.confirm(f"Delete {what}from {len(due)} files in {folder}?"):
        return 1
    deleted = 0
    with Folder(folder).maintained(), progress("deleting", len(due)) as advance:
        for number, path in enumerate(due, 1):
            try:
                names = path.stat().st_nlink
                made = rewrite(path, path, keeps=keeps)
            except (PebbleError, OSError) as error:
                left += report_left(error)
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
