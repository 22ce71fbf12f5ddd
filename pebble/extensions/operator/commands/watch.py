"""``pebble watch``: receives one picture of a robot, as an operator does."""

from __future__ import annotations

import time
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pebble.config import load
from pebble.errors import PebbleError
from pebble.extensions.operator.client.connection import Target, connected, put_account_into_topics
from pebble.extensions.operator.commands.options import BrokerUrl, CaCert, PasswordFile
from pebble.extensions.operator.notices import noticed
from pebble.extensions.operator.signals import interrupted_by_signals
from pebble.runtime.as_owner import as_owner
from pebble.runtime.whole_file import write

if TYPE_CHECKING:
    from pebble.extensions.media.cameras import Picture

_CAPABILITIES_TIMEOUT_S = 5.0  # for the robot's retained capabilities to arrive
_FIRST_PICTURE_S = 15.0  # a camera that is off takes a moment to open
_TICK_S = 0.1

RobotArgument = Annotated[
    str, typer.Argument(help="A robot's config file, or with --url its id.", metavar="ROBOT", show_default=False)
]
EncodingOption = Annotated[
    str | None, typer.Option("--encoding", "-e", help="json, pbvd or h264. [default: the robot's]")
]


def watch(
    robot: RobotArgument,
    picture: Annotated[Path, typer.Option(help="The file to write, PNG or JPEG.", metavar="FILE", show_default=False)],
    url: BrokerUrl = None,
    encoding: EncodingOption = None,
    password_file: PasswordFile = None,
    ca_cert: CaCert = None,
) -> int:
    """Write one picture of a robot's camera into a file.

    A robot without a remote broker is seen on its own machine. The page of `pebble web` shows pictures as they come,
    with what scripts draw over them, and plays the sound.

    \b
        pebble watch goob.json --picture front.png
        pebble watch goob --url mqtt://127.0.0.1 -e h264 --picture front.png
    """
    target = _target(robot, url, password_file, ca_cert)
    with interrupted_by_signals():  # else the camera would continue without a viewer
        if target.config is not None and not target.remote:
            from pebble.extensions.media.cameras import camera  # its shared memory is of Linux only

            typer.echo(f"pebble: {robot} names no remote broker: this machine's camera", err=True)
            with camera(target.config, timeout=_FIRST_PICTURE_S) as pictures:
                newest = next(pictures)
        else:
            newest = _received(target, encoding)
    _save(newest, picture)
    height, width = newest.shape[:2]
    typer.echo(f"{picture}: {width}×{height}")
    return 0


def _received(target: Target, encoding: str | None) -> Picture:
    """Return the first picture from the operators' broker. Raises PebbleError if none comes."""
    from pebble.extensions.operator.client.media_receiver import MediaReceiver

    with connected(target) as (transport, names), closing(MediaReceiver(transport, names.base)) as receiver:
        put_account_into_topics(transport, names, lambda base: base == names.base and receiver.robot.named)
        with noticed(lambda: f"waiting for a picture of {receiver.robot.name}"):
            receiver.wait_for_capabilities(_CAPABILITIES_TIMEOUT_S)
            receiver.request("video", encoding)
            end = time.monotonic() + _FIRST_PICTURE_S
            while receiver.newest is None:
                if time.monotonic() > end:
                    raise PebbleError(f"no picture came from {receiver.robot.name} within {_FIRST_PICTURE_S:.0f} s")
                receiver.poll()
                time.sleep(_TICK_S)
        return receiver.newest.picture


def _save(picture: Picture, file: Path) -> None:
    """Write a BGR picture in the format of the file's suffix. Raises PebbleError if that fails."""
    import cv2

    try:
        _, content = cv2.imencode(file.suffix, picture)
    except cv2.error:
        raise PebbleError(f"{file}: cannot write this kind of picture, name it .png or .jpg") from None
    with as_owner(file.parent):
        write(file, content.tobytes(), 0o644, PebbleError)


def _target(robot: str, url: str | None, password_file: Path | None, ca_cert: Path | None) -> Target:
    """Return where to connect: at ``url`` or, by a config, at operators' broker if it names one, else at the robot."""
    if url is not None:
        return Target(url=url, robot=robot, password_file=password_file, ca_cert=ca_cert)
    if not Path(robot).is_file():
        raise PebbleError(f"{robot} is not a config file: name one, or add --url with the broker of the robot {robot}")
    bridge = load(robot).services.mqtt_bridge
    remote = bool(bridge.remote_mqtt.host) or bridge.remote is not None
    return Target(config=Path(robot), remote=remote, program="watch")
