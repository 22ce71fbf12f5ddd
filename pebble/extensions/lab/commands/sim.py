"""``pebble sim`` and ``pebble demo``: simulated robots and devices; MCUs run the real firmware on simulated pins."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from pebble.extensions.operator.commands.options import CaCert, PasswordFile
from pebble.extensions.operator.commands.target import broker_of

if TYPE_CHECKING:
    from pebble.config import Config
    from pebble.transports import MqttSettings

_SERIAL = ("goob", "fred", "goob_imu")
_WIFI = ("minilamp", "benjr")
_NAMED = (*_WIFI, "world")  # kinds that take an id or a file
#: By option: the kinds that take it. An option that is missing here is for all kinds.
_KINDS_OF = {
    "link": _SERIAL,
    "broker": (*_WIFI, "fleet"),
    "password_file": (*_WIFI, "fleet"),
    "ca_cert": (*_WIFI, "fleet"),
    "called": _WIFI,
    "files": _WIFI,
    "robots": ("fleet",),
    "folder": ("world",),
    "trace": (*_SERIAL, *_WIFI, "world"),
    "trace_output": _SERIAL,
    "control": (*_SERIAL, "world"),
}

Kind = Literal["goob", "fred", "goob_imu", "minilamp", "benjr", "fleet", "world"]


def sim(
    context: typer.Context,
    kind: Annotated[Kind, typer.Argument(help="What to simulate.", metavar="KIND", show_default=False)],
    name: Annotated[
        str | None,
        typer.Argument(help="A MiniLAMP's or BenJr's id, or a world's file.", metavar="[ID|FILE]", show_default=False),
    ] = None,
    link: Annotated[
        Path | None, typer.Option(help="Path of the serial port. [default: /tmp/pebble-KIND]", metavar="PATH")
    ] = None,
    broker: Annotated[
        str | None,
        typer.Option(
            "--broker", "-b", help="mqtt://[USER@]HOST[:PORT], mqtts://… or the robot's config.", metavar="URL"
        ),
    ] = None,
    called: Annotated[str, typer.Option("--name", help="What people call the robot.", metavar="TEXT")] = "",
    files: Annotated[
        Path | None, typer.Option(help="Folder for the files of the board, which survive it.", metavar="FOLDER")
    ] = None,
    robots: Annotated[int, typer.Option("--robots", "-n", min=1, help="How many robots a fleet has.")] = 10,
    folder: Annotated[
        Path | None, typer.Option(help="For a world's serial ports. [default: /tmp/pebble-world-…]", metavar="FOLDER")
    ] = None,
    trace: Annotated[
        Path | None,
        typer.Option(help="File for what boards receive and motors do; of a world the folder.", metavar="PATH"),
    ] = None,
    trace_output: Annotated[bool, typer.Option("--trace-said", help="Also trace what the board sends.")] = False,
    control: Annotated[bool, typer.Option("--control", help="Read commands, such as unplug, from stdin.")] = False,
    password_file: PasswordFile = None,
    ca_cert: CaCert = None,
) -> int:
    """Simulate a board, a robot, many robots or a room, until Ctrl-C. Boards run the firmware of the real ones.

    goob, fred and goob_imu are boards on a pseudo terminal: set serial.port in a robot's config to its link.
    minilamp and benjr are whole robots on a real broker; fleet is many of them, minilamp-001, benjr-001 and so on, and
    exits 0 only if all were online at the end. world is a room with walls and AprilTags, which robots' cameras see; it
    prints what belongs in their configs.

    \b
        pebble sim goob --link /tmp/goob
        pebble sim benjr benjr-2 --broker mqtt://127.0.0.1
        pebble sim minilamp --broker minilamp.json
        pebble sim fleet --robots 200 --broker mqtt://127.0.0.1
        pebble sim world world.json
    """
    _check_options(context, kind)
    if name is not None and kind not in _NAMED:
        raise typer.BadParameter(f"{kind} takes no {name}")
    if kind == "world":
        from pebble.extensions.lab.simulation.world.program import ROOM
        from pebble.extensions.lab.simulation.world.program import run as run_world

        return run_world(Path(name or ROOM), folder, trace=trace, control=control)
    if kind in _SERIAL:
        from pebble.extensions.lab.simulation.mcu import run as run_mcu

        path = link or Path(tempfile.gettempdir(), f"pebble-{kind}")
        return run_mcu(kind, path, trace=trace, trace_output=trace_output, control=control)
    if broker is None:
        raise typer.BadParameter(f"{kind} needs --broker URL")
    address, config = _broker(broker, password_file, ca_cert)
    if kind == "fleet":
        from pebble.extensions.lab.simulation.networked import run_fleet

        return run_fleet(address, robots)
    return _run_wireless(kind, name, address, config, called, trace=trace, files=files)


def demo(
    seconds: Annotated[
        float | None, typer.Option("--seconds", "-s", min=1, help="End after this long of driving.", show_default=False)
    ] = None,
    phone: Annotated[
        bool, typer.Option("--phone", help="Open the page to the network: https, a login and a QR code.")
    ] = False,
) -> int:
    """Four simulated robots, driven by a scripted operator through one broker, until Ctrl-C.

    Goob on Zenoh, Fred on MQTT, MiniLAMP and BenJr on MCUs with their own firmware; needs no hardware.
    With --seconds it exits 0 only if every robot moved and stopped as commanded.

    \b
        pebble demo
        pebble demo --seconds 30
        pebble demo --phone
    """
    from pebble.extensions.lab.demo.main import run

    return run(seconds, for_phones=phone)


def _check_options(context: typer.Context, kind: str) -> None:
    """Raise BadParameter for an option that this ``kind`` of simulation does not have."""
    for parameter in context.command.params:
        name = str(parameter.name)
        source = context.get_parameter_source(name)
        is_given = source is not None and source.name == "COMMANDLINE"
        if is_given and name in _KINDS_OF and kind not in _KINDS_OF[name]:
            raise typer.BadParameter(f"{kind} takes no {parameter.opts[0]}")


def _run_wireless(
    kind: str,
    id_: str | None,
    broker: MqttSettings,
    config: Config | None,
    called: str,
    *,
    trace: Path | None,
    files: Path | None,
) -> int:
    """Run a MiniLAMP or BenJr. From ``config`` come its level of security, and what the command line does not name."""
    from pebble.contract.identity import Identity
    from pebble.extensions.lab.simulation.networked import run

    if config is None:
        identity, security = Identity("pebble", "robots", id_ or kind), None
    else:
        robot = config.robot
        identity, security = Identity(robot.system, robot.type, id_ or robot.id), config.security
        called = called or robot.name or ""
    typer.echo(f"{identity} connects to the broker at {broker.host}:{broker.port}; Ctrl-C ends it")
    return run(kind, identity, broker, name=called, security=security, trace=trace, files=files)


def _broker(broker: str, password_file: Path | None, ca_cert: Path | None) -> tuple[MqttSettings, Config | None]:
    """Return the broker that a URL or a config file names, and the config. Raises PebbleError."""
    from pebble.config import load
    from pebble.runtime.connections import LOCAL_RECONNECT_S, mqtt_settings

    if "://" in broker or broker.startswith("zenoh:"):
        return broker_of("--broker", broker, password_file, ca_cert), None
    config = load(Path(broker))  # of a MiniLAMP or BenJr: its only broker is local_mqtt
    return mqtt_settings(config.local_mqtt, reconnect_max_s=LOCAL_RECONNECT_S), config


def register(app: typer.Typer) -> None:
    app.command("sim")(sim)
    app.command("demo")(demo)
