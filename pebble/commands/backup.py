"""``pebble setup --backup``: packs what a new machine needs to be this robot."""

from pathlib import Path

import typer

from pebble.runtime.places import Places
from pebble.runtime.whole_file import write_new
from pebble.setup import backup as backups


def backup(file: Path, places: Places) -> int:
    """Write the tar file, and read it again."""
    if file.exists():
        raise typer.BadParameter(f"{file} exists: name another file, or remove it")
    made = backups.make(places)
    write_new(file, backups.packed(made))
    back = backups.read(file)  # as the disk has it
    typer.echo(f"{file}: {back.about.id}, {len(back.files)} files, {back.bytes / 1e6:.1f} MB")
    for place, why in made.left_out.items():
        typer.echo(f"not in it: {place}: {why}")
    typer.echo(f"pebble: warning: {back.about.note}", err=True)
    return 0
