"""``pebble watch`` and ``pebble snapshot``: see and hear a robot, as an operator does."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pebble.commands.connection import PASSWORD, Target, connected
from pebble.errors import PebbleError
from pebble.signals import interrupted_by_signals

if TYPE_CHECKING:
    from pebble.media.audience import Audience

_KNOWN_S = 5.0  # for the robot to say what it can do
_FIRST_PICTURE_S = 15.0  # a camera that rests takes a moment to open
_TICK_S = 0.1

RobotArgument = Annotated[
    str, typer.Argument(help="A robot's config file, or with --url its id.", metavar="ROBOT", show_default=False)
]
UrlOption = Annotated[
    str | None,
    typer.Option(help="mqtt://[USER@]HOST[:PORT] or mqtts://… of the operators' broker.", metavar="URL"),
]
EncodingOption = Annotated[
    str | None, typer.Option("--encoding", "-e", help="json, pbvd, pbvz or h264. [default: the robot's]")
]
PasswordOption = Annotated[
    Path | None, typer.Option(help=f"File with the password for --url; else ${PASSWORD}.", metavar="FILE")
]
CaOption = Annotated[Path | None, typer.Option(help="Authority to trust with mqtts://.", metavar="FILE")]


def watch(
    robot: RobotArgument,
    url: UrlOption = None,
    encoding: EncodingOption = None,
    sound: Annotated[bool, typer.Option("--sound/--no-sound", help="Listen, too.")] = True,
    seconds: Annotated[float | None, typer.Option("--seconds", "-s", min=0.5, help="Stop after this long.")] = None,
    out: Annotated[
        Path | None,
        typer.Option(help="Write pictures and sound into this folder, even with a screen.", metavar="FOLDER"),
    ] = None,
    password_file: PasswordOption = None,
    ca_cert: CaOption = None,
) -> int:
    """See a robot's camera and hear its microphone, until Ctrl-C.

    Opens a window, and plays the sound through aplay; without a screen a picture a second (PNG) and the sound (WAV) go
    into a folder.

    \b
        pebble watch goob.json
        pebble watch goob --url mqtt://127.0.0.1 --encoding h264 --seconds 10
    """
    from pebble.commands import screens

    end = float("inf") if seconds is None else time.monotonic() + seconds
    with ExitStack() as stack:
        stack.enter_context(interrupted_by_signals())  # else the camera would go on with nobody watching
        audience = stack.enter_context(_audience(robot, url, password_file, ca_cert))
        screen = stack.enter_context(screens.best(audience.name, out))
        audience.begin(encoding, sound=sound and screen.can_hear)
        while time.monotonic() < end and screen.open:
            audience.keep_going()
            screen.show(audience)
            time.sleep(_TICK_S)
        seen = audience.pictures.total
    typer.echo(screen.summary())
    return 0 if seen else 1


def snapshot(
    robot: RobotArgument,
    file: Annotated[Path, typer.Argument(help="PNG or JPEG to write.", metavar="FILE", show_default=False)],
    url: UrlOption = None,
    encoding: EncodingOption = None,
    password_file: PasswordOption = None,
    ca_cert: CaOption = None,
) -> int:
    """Write one picture of a robot's camera into a file.

    \b
        pebble snapshot goob.json front.png
        pebble snapshot goob front.png --url mqtt://127.0.0.1
    """
    from pebble.commands.screens import save_picture

    with interrupted_by_signals(), _audience(robot, url, password_file, ca_cert) as audience:
        audience.begin(encoding, sound=False)
        end = time.monotonic() + _FIRST_PICTURE_S
        while audience.newest is None:
            if time.monotonic() > end:
                raise PebbleError(f"no picture came from {audience.name} within {_FIRST_PICTURE_S:.0f} s")
            audience.keep_going()
            time.sleep(_TICK_S)
        save_picture(audience.newest.picture, file)
        height, width = audience.newest.picture.shape[:2]
    typer.echo(f"{file}: {width}×{height}")
    return 0


@contextmanager
def _audience(robot: str, url: str | None, password_file: Path | None, ca_cert: Path | None) -> Iterator[Audience]:
    from pebble.media.audience import Audience

    with connected(_target(robot, url, password_file, ca_cert)) as (transport, names):
        audience = Audience(transport, names.base)
        try:
            audience.wait_known(_KNOWN_S)
            yield audience
        finally:
            audience.end()


def _target(robot: str, url: str | None, password_file: Path | None, ca_cert: Path | None) -> Target:
    if url is not None:
        return Target(url=url, robot=robot, password_file=password_file, ca_cert=ca_cert)
    if not Path(robot).is_file():
        raise PebbleError(f"{robot} is no config file: name one, or say with --url where the robot {robot} is heard")
    return Target(config=Path(robot), remote=True)


def register(app: typer.Typer) -> None:
    app.command("watch")(watch)
