"""``pebble setup``: makes an installed package a running robot, and backs robots up."""

from pathlib import Path
from typing import Annotated

import typer

from pebble.extensions.checks.new_file import why_taken, write_new
from pebble.extensions.operator.client.page_packages import require_packages
from pebble.extensions.operator.places import Places

_Answers = Annotated[
    Path | None, typer.Option(help="File with the answers, as JSON; nothing is asked.", metavar="FILE")
]
_Backup = Annotated[Path | None, typer.Option(help="Only pack what a new machine needs.", metavar="FILE")]
_From = Annotated[Path | None, typer.Option("--from", help="Make a blank machine this robot.", metavar="FILE")]


def setup(answers: _Answers = None, backup: _Backup = None, from_: _From = None) -> int:
    """Make a robot of this machine: config, passwords, broker, certificate, first user, service.

    It asks six questions. On a robot it offers the present answers, and changes what differs; what was written into
    the config by hand stays.

    A backup has config, people, the emergency stop, certificates, accounts and calibration, but no recordings. It holds
    passwords and private keys, and only its owner can read it; nothing is overwritten. The robot may run meanwhile.

    \b
    As root:
        pebble setup
        pebble setup --answers goob.answers.json
        pebble setup --backup goob.tar
        pebble setup --from goob.tar            after the SD card died
    """
    if backup is not None:
        return back_up(backup, Places())
    require_packages("pebble setup")
    from pebble.extensions.install.setup.answers import AnswersError
    from pebble.extensions.install.setup.session import set_up  # imports what only Linux has
    from pebble.extensions.install.setup.system import System

    try:
        return set_up(System(), answers, from_)
    except AnswersError as error:
        for line in str(error).splitlines():
            typer.echo(f"pebble: {line}", err=True)
        return 2


def back_up(file: Path, places: Places) -> int:
    """Write the backup as a tar file, and read it again to check it."""
    from pebble.extensions.install.setup import backup as backups  # imports what only Linux has

    if taken := why_taken(file, ".tar"):
        raise typer.BadParameter(taken)
    backup = backups.make(places)
    write_new(file, backups.packed(backup))
    written = backups.read(file)  # as the disk has it
    typer.echo(f"{file}: {written.about.id}, {len(written.files)} files, {written.bytes / 1e6:.1f} MB")
    for place, why in backup.left_out.items():
        typer.echo(f"not in it: {place}: {why}")
    typer.echo(f"pebble: warning: {written.about.note}", err=True)
    return 0
