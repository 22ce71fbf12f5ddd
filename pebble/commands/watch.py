"""``pebble watch``: receives a robot's pictures and sound, as an operator does."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pebble.client.connection import Target, connected, put_names
from pebble.commands.options import CaCert, PasswordFile
from pebble.config import load
from pebble.errors import PebbleError
from pebble.runtime.signals import interrupted_by_signals

if TYPE_CHECKING:
    from pebble.client.media_receiver import MediaReceiver

_CAPABILITIES_TIMEOUT_S = 5.0  # for the robot's retained capabilities to arrive
_FIRST_PICTURE_S = 15.0  # a camera that is off takes a moment to open
_TICK_S = 0.1

RobotArgument = Annotated[
    str, typer.Argument(help="A robot's config file, or with --url its id.", metavar="ROBOT", show_default=False)
]
UrlOption = Annotated[
    str | None, typer.Option(help="mqtt://[USER@]HOST[:PORT] or mqtts://… of the operators' broker.", metavar="URL")
]
EncodingOption = Annotated[
    str | None, typer.Option("--encoding", "-e", help="json, pbvd, pbvz or h264. [default: the robot's]")
]


def watch(
    robot: RobotArgument,
    url: UrlOption = None,
    encoding: EncodingOption = None,
    sound: Annotated[bool, typer.Option("--sound/--no-sound", help="Play audio.")] = True,
    seconds: Annotated[float | None, typer.Option("--seconds", "-s", min=0.5, help="Stop after this long.")] = None,
    out: Annotated[
        Path | None,
        typer.Option(help="Write pictures and sound into this folder, even with a screen.", metavar="FOLDER"),
    ] = None,
    picture: Annotated[
        Path | None, typer.Option(help="Only write one picture into this file, PNG or JPEG.", metavar="FILE")
    ] = None,
    password_file: PasswordFile = None,
    ca_cert: CaCert = None,
) -> int:
    """Show a robot's camera, with what scripts draw over it, and play its microphone, until Ctrl-C.

    Opens a window, and plays sound through aplay. Without a screen it writes a picture per second (PNG) and the sound
    (WAV) into a folder. A robot without a remote broker is shown on its own machine, without sound.

    \b
        pebble watch goob.json
        pebble watch goob --url mqtt://127.0.0.1 --encoding h264 --seconds 10
        pebble watch goob.json --picture front.png
    """
    from pebble.commands.terminal import screens

    if picture is not None:
        if out is not None or seconds is not None:
            raise typer.BadParameter("--picture writes one picture, and ends: leave out --out and --seconds")
        with interrupted_by_signals(), _receiver(robot, url, password_file, ca_cert) as receiver:
            return _write_picture(receiver, encoding, picture)
    end = float("inf") if seconds is None else time.monotonic() + seconds
    with ExitStack() as stack:
        stack.enter_context(interrupted_by_signals())  # else the camera would continue without a viewer
        receiver = stack.enter_context(_receiver(robot, url, password_file, ca_cert))
        screen = stack.enter_context(screens.best(receiver.name, out))
        receiver.request(encoding, sound=sound and screen.can_play)
        while time.monotonic() < end and screen.open:
            receiver.poll()
            screen.show(receiver)
            time.sleep(_TICK_S)
        seen = receiver.pictures.count
    typer.echo(screen.summary())
    return 0 if seen else 1


def _write_picture(receiver: MediaReceiver, encoding: str | None, file: Path) -> int:
    from pebble.commands.terminal.screens import save_picture

    receiver.request(encoding, sound=False)
    end = time.monotonic() + _FIRST_PICTURE_S
    while receiver.newest is None:
        if time.monotonic() > end:
            raise PebbleError(f"no picture came from {receiver.name} within {_FIRST_PICTURE_S:.0f} s")
        receiver.poll()
        time.sleep(_TICK_S)
    save_picture(receiver.newest.picture, file)
    height, width = receiver.newest.picture.shape[:2]
    typer.echo(f"{file}: {width}×{height}")
    return 0


@contextmanager
def _receiver(robot: str, url: str | None, password_file: Path | None, ca_cert: Path | None) -> Iterator[MediaReceiver]:
    from pebble.client.media_receiver import MediaReceiver

    target = _target(robot, url, password_file, ca_cert)
    with connected(target) as (transport, names):
        if target.config is not None and not target.remote:
            from pebble.client.local_camera import LocalReceiver  # its shared memory is of Linux only

            typer.echo(f"pebble: {robot} names no remote broker: this machine's camera, without sound", err=True)
            receiver: MediaReceiver = LocalReceiver(transport, names.base, target.config)
        else:
            receiver = MediaReceiver(transport, names.base)
            estop = receiver.estop
            put_names(transport, names, lambda base: base == estop.base and estop.named)
        try:
            receiver.wait_for_capabilities(_CAPABILITIES_TIMEOUT_S)
            yield receiver
        finally:
            receiver.close()


def _target(robot: str, url: str | None, password_file: Path | None, ca_cert: Path | None) -> Target:
    if url is not None:
        return Target(url=url, robot=robot, password_file=password_file, ca_cert=ca_cert)
    if not Path(robot).is_file():
        raise PebbleError(f"{robot} is not a config file: name one, or add --url with the broker of the robot {robot}")
    bridge = load(robot).services.mqtt_bridge
    remote = bool(bridge.remote_mqtt.host) or bridge.remote is not None
    return Target(config=Path(robot), remote=remote, program="watch")
