"""``pebble report``: packs what helps to find a fault, without a secret."""

from pathlib import Path
from typing import Annotated

import typer

from pebble.commands.options import RootOption
from pebble.setup.places import Places

ZipArgument = Annotated[Path, typer.Argument(help="Zip file to write.", metavar="FILE.zip", show_default=False)]
OtherConfig = Annotated[
    Path | None,
    typer.Argument(
        help="A robot's config file. [default: the installed one]", metavar="CONFIG", exists=True, show_default=False
    ),
]


def report(file: ZipArgument, config: OtherConfig = None, root: RootOption = Path("/")) -> int:
    """Pack what helps to find a fault: config, doctor, status, journal, units, slots, versions, devices.

    Passwords and keys are masked; then every one that is known on this machine is searched for in it, and if one is
    found, nothing is written. Run it as root: it searches only for what it may read.

    \b
        pebble report goob.zip
        pebble report goob.zip goob.json
    """
    from pebble.selftest.new_file import write_new  # of Linux only
    from pebble.selftest.report import make

    if file.exists():
        raise typer.BadParameter(f"{file} exists: name another file, or remove it")
    made = make(Places(root.absolute()), None if config is None else config.absolute())
    write_new(file, made.packed())
    typer.echo(f"{file}: {', '.join(made.parts)}")
    for name, why in made.missing.items():
        typer.echo(f"missing: {name}: {why}")
    if made.unread:
        typer.echo(f"pebble: warning: passwords in {len(made.unread)} files were not searched for: use sudo", err=True)
    return 0
