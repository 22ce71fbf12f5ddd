"""``pebble setup``: from a blank machine to a robot that runs; it also backs up, restores, renames and undoes."""

from pathlib import Path
from typing import Annotated, Any

import typer

from pebble.client.page.packages import require_packages
from pebble.contract.serial_protocols import SERIAL_PROTOCOLS
from pebble.setup.places import Places
from pebble.setup.questions import AnswersError

_Answers = Annotated[
    Path | None, typer.Option(help="File with the answers, as JSON; nothing is asked.", metavar="FILE")
]
_Camera = Annotated[str | None, typer.Option(help="A device, libcamera, synthetic, or none.", metavar="CAMERA")]
_BrokerPassword = Annotated[Path | None, typer.Option(help="File with that account's password.", metavar="FILE")]
_Backup = Annotated[
    Path | None, typer.Option("--backup", help="Only pack what a new machine needs to be this robot.", metavar="FILE")
]
_From = Annotated[Path | None, typer.Option("--from", help="Restore a backup.", metavar="FILE")]
_As = Annotated[str | None, typer.Option("--as", help="With --from: a second robot, of this name.", metavar="NAME")]
_Purge = Annotated[
    bool, typer.Option("--purge", help="With --undo: erase also keys, people, state and what was changed by hand.")
]


def setup(
    answers: _Answers = None,
    robot: Annotated[str | None, typer.Option("--id", help="Name of the robot.", metavar="NAME")] = None,
    port: Annotated[str | None, typer.Option(help="The board's serial port, or none.", metavar="PORT")] = None,
    protocol: Annotated[str | None, typer.Option(help=f"{', '.join(SERIAL_PROTOCOLS)}.", metavar="NAME")] = None,
    baud: Annotated[int | None, typer.Option(help="The board's speed.", metavar="BAUD", min=1)] = None,
    camera: _Camera = None,
    broker: Annotated[str | None, typer.Option(help="here, HOST[:PORT], or none.", metavar="BROKER")] = None,
    broker_user: Annotated[str | None, typer.Option(help="The robot's account there.", metavar="NAME")] = None,
    broker_password_file: _BrokerPassword = None,
    broker_ca: Annotated[Path | None, typer.Option(help="Certificate authority of the broker.", metavar="FILE")] = None,
    page: Annotated[bool | None, typer.Option("--page/--no-page", help="The operator page, for phones.")] = None,
    user: Annotated[str | None, typer.Option(help="First user of the page.", metavar="NAME")] = None,
    password_file: Annotated[Path | None, typer.Option(help="File with the user's password.", metavar="FILE")] = None,
    backup: _Backup = None,
    from_: _From = None,
    as_: _As = None,
    yes: Annotated[bool, typer.Option("--yes", help="Do it without asking.")] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Show each step, and write nothing.")] = False,
    undo: Annotated[bool, typer.Option("--undo", help="Remove what setup made; what the robot saved stays.")] = False,
    purge: _Purge = False,
    root: Annotated[Path, typer.Option(help="Another root than that of this machine.", metavar="DIR")] = Path("/"),
) -> int:
    """Make a robot of this machine: config, passwords, broker, certificate, first user, service.

    It asks six questions; what was done before stays as it is. With one other answer it changes what differs.

    A backup has config, people, the stop, certificates, accounts and calibration, but no recordings. It holds
    passwords and private keys, and only its owner can read it; nothing is overwritten. The robot may run meanwhile.

    \b
        sudo pebble setup
        pebble setup --dry-run --answers goob.answers.json
        sudo pebble setup --camera none              one other answer
        sudo pebble setup --id fred                  another name
        sudo pebble setup --backup goob.tar
        sudo pebble setup --from goob.tar            after the SD card died
        sudo pebble setup --from goob.tar --as fred  a second robot
        sudo pebble setup --undo --purge             before it is given away
    """
    places = Places(root.absolute())
    if backup is not None:
        from pebble.commands.backup import backup as write_backup  # of Linux only

        return write_backup(backup, places)
    given: dict[str, Any] = {
        "id": robot, "port": port, "protocol": protocol, "baud": baud, "camera": camera,
        "broker": broker, "broker_user": broker_user, "broker_password_file": broker_password_file,
        "broker_ca": None if broker_ca is None else str(broker_ca.absolute()),
        "page": page, "user": user, "password_file": password_file,
    }  # fmt: skip
    require_packages("pebble setup")
    from pebble.setup.session import Session  # of Linux only

    session = Session(places, yes=yes, dry=dry_run)
    try:
        _together("--purge", purge, "--undo", undo)
        _together("--as", as_, "--from FILE", from_)
        return session.undo(purge=purge) if undo else session.set_up(answers, given, from_, as_)
    except AnswersError as error:
        for line in str(error).splitlines():
            typer.echo(f"pebble: {line}", err=True)
        return 2


def _together(option: str, value: object, needed: str, other: object) -> None:
    if value not in (None, False) and other in (None, False):
        raise AnswersError(f"{option} needs {needed}")
