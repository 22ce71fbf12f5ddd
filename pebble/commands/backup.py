"""``pebble backup``: packs what a new machine needs to be this robot."""

from pathlib import Path
from typing import Annotated

import typer

from pebble.commands.options import RootOption
from pebble.setup.places import Places

TarArgument = Annotated[Path, typer.Argument(help="Tar file to write.", metavar="FILE", show_default=False)]


def backup(file: TarArgument, root: RootOption = Path("/")) -> int:
    """Pack what a new machine needs to be this robot: config, people, the stop, certificates, accounts, calibration.

    The file holds passwords and private keys, and only its owner can read it; nothing is overwritten. The robot may
    run meanwhile. Recordings are not in it.

    \b
        pebble backup goob.tar
    """
    from pebble.selftest.new_file import write_new
    from pebble.setup import backup as backups  # of Linux only

    if file.exists():
        raise typer.BadParameter(f"{file} exists: name another file, or remove it")
    made = backups.make(Places(root.absolute()))
    write_new(file, backups.packed(made))
    back = backups.read(file)  # as the disk has it
    typer.echo(f"{file}: {back.about.id}, {len(back.files)} files, {back.bytes / 1e6:.1f} MB")
    for place, why in made.left_out.items():
        typer.echo(f"not in it: {place}: {why}")
    typer.echo(f"pebble: warning: {back.about.note}", err=True)
    return 0
