"""``pebble sim`` and ``pebble demo``: simulated robots and devices; MCUs run the real firmware on simulated pins."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pebble.commands.options import CaCert, PasswordFile

if TYPE_CHECKING:
    from pebble.config import Config
    from pebble.simulation.wireless import BrokerAddress

_GROUP_HELP = """The real firmware of a robot's MCU on simulated pins.

Goob's and Fred's is on a serial port, MiniLAMP's and BenJr's on Wi-Fi.

\b
    pebble sim goob --link /tmp/goob
    pebble sim outlets --link /tmp/outlets
    pebble sim minilamp --broker mqtt://127.0.0.1
    pebble sim fleet --robots 200 --broker mqtt://127.0.0.1
    pebble sim world world.json

A loudspeaker that records what is played stands in for aplay.

\b
    pebble sim loudspeaker --record /tmp/played clip.wav
"""
_BROKER_HELP = "mqtt://[USER@]HOST[:PORT], mqtts://… or a robot's config file."

_Link = Annotated[
    Path | None, typer.Option("--link", help="Path of the serial port. [default: /tmp/pebble-…]", metavar="PATH")
]
_Charging = Annotated[bool, typer.Option("--charging", help="Start with the charger connected.")]
_Broker = Annotated[str, typer.Option("--broker", "-b", help=_BROKER_HELP, metavar="URL", show_default=False)]
_Id = Annotated[str | None, typer.Option("--id", help="The robot's id. [default: its kind]", metavar="ID")]


def goob(link: _Link = None, charging: _Charging = False) -> int:
    """Goob's motor MCU on a pseudo terminal, until Ctrl-C.

    Set serial.port in the robot's config to the path of the link.

    \b
        pebble sim goob --link /tmp/goob
    """
    return _serial("goob", link, charging)


def fred(link: _Link = None, charging: _Charging = False) -> int:
    """Fred's motor MCU on a pseudo terminal, until Ctrl-C.

    Set serial.port in the robot's config to the path of the link.

    \b
        pebble sim fred --link /tmp/fred
    """
    return _serial("fred", link, charging)


def goob_imu(link: _Link = None) -> int:
    """Goob's IMU board on a pseudo terminal, until Ctrl-C.

    Set serial.port of an instance in the config to the path of the link.

    \b
        pebble sim goob_imu --link /tmp/goob-imu
    """
    return _serial("goob_imu", link, False)


def outlets(
    link: _Link = None,
    count: Annotated[int, typer.Option("--outlets", "-n", min=1, max=4, help="How many.")] = 4,
    unreachable: Annotated[
        list[str] | None,
        typer.Option(help="An outlet without its relay: o4. May be given several times.", metavar="oN"),
    ] = None,
    trace: Annotated[Path | None, typer.Option(help="Append each change of a relay to this file.")] = None,
) -> int:
    """A station of switched sockets on a pseudo terminal, until Ctrl-C. It prints what each relay does.

    Set serial.port of an instance in the config to the path of the link.

    \b
        pebble sim outlets --link /tmp/outlets
        pebble sim outlets --outlets 2 --unreachable o2
    """
    options = ["--outlets", str(count), *(["--trace", str(trace)] if trace is not None else [])]
    return _serial("outlets", link, False, *options, *(f"--unreachable={outlet}" for outlet in unreachable or ()))


def minilamp(broker: _Broker, id_: _Id = None, password_file: PasswordFile = None, ca_cert: CaCert = None) -> int:
    """A whole MiniLAMP on a real broker, until Ctrl-C.

    \b
        pebble sim minilamp --broker mqtt://127.0.0.1
        pebble sim minilamp --broker minilamp.json
    """
    return _wireless("minilamp", id_, broker, password_file, ca_cert)


def benjr(broker: _Broker, id_: _Id = None, password_file: PasswordFile = None) -> int:
    """A whole BenJr on a real broker, until Ctrl-C.

    \b
        pebble sim benjr --broker mqtt://127.0.0.1 --id benjr-2
    """
    return _wireless("benjr", id_, broker, password_file, None)


def fleet(
    broker: _Broker,
    robots: Annotated[int, typer.Option("--robots", "-n", min=1, help="How many.")] = 10,
    kind: Annotated[
        list[str] | None, typer.Option(help="May be given several times. [default: minilamp, benjr]")
    ] = None,
    seconds: Annotated[float | None, typer.Option("--seconds", "-s", min=1, help="End after this long.")] = None,
    password_file: PasswordFile = None,
    ca_cert: CaCert = None,
) -> int:
    """Many whole robots on a real broker, until Ctrl-C.

    Their ids are minilamp-001, benjr-001, minilamp-002 and so on. With --seconds it exits 0 only if all
    were online at the end.

    \b
        pebble sim fleet --robots 200 --broker mqtt://127.0.0.1:1883
        pebble sim fleet -n 3 --kind minilamp --broker mqtts://broker.lan --seconds 60
    """
    from pebble.simulation.fleet_program import FleetOptions, run
    from pebble.simulation.wireless import KINDS

    address = _address(broker, password_file, ca_cert)[0]
    return run(FleetOptions(robots=robots, broker=address, kinds=kind or KINDS, seconds=seconds))


def loudspeaker(
    file: Annotated[str, typer.Argument(help="A WAV file, or - for raw sound from standard input.", metavar="FILE")],
    record: Annotated[
        Path | None, typer.Option(help="For events.jsonl and WAV files of what is played.", metavar="FOLDER")
    ] = None,
    exclusive: Annotated[
        bool, typer.Option("--exclusive", help="Play one sound at a time, as a sound card without a mixer does.")
    ] = False,
    file_type: Annotated[str, typer.Option("-t", "--file-type", help="wav, or raw: signed 16-bit samples.")] = "wav",
    format_: Annotated[str, typer.Option("-f", "--format", help="Of raw sound: S16_LE.")] = "S16_LE",
    channels: Annotated[int, typer.Option("-c", "--channels", min=1, help="Of raw sound.")] = 1,
    rate: Annotated[int, typer.Option("-r", "--rate", min=1, help="Of raw sound, in Hz.")] = 8000,
    device: Annotated[str, typer.Option("-D", "--device", help="Not used.")] = "default",
    quiet: Annotated[bool, typer.Option("-q", "--quiet", help="Not used.")] = False,
) -> int:
    """A loudspeaker that records: takes aplay's place as player_command of a robot without sound.

    It plays in real time. Without --record it prints when a sound begins and ends, as JSON.
    Robots start it faster as `python -m pebble.simulation.loudspeaker`, with the same options.

    \b
        pebble sim loudspeaker --record /tmp/played clip.wav
        pebble sim loudspeaker -t raw -f S16_LE -c 1 -r 16000 - < sound.raw
    """
    from pebble.simulation.loudspeaker import main

    del quiet
    options = [*(["--record", str(record)] if record is not None else []), *(["--exclusive"] if exclusive else [])]
    raw = ["-t", file_type, "-f", format_, "-c", str(channels), "-r", str(rate), "-D", device]
    return main([*options, *raw, file])


def world(
    file: Annotated[
        Path | None, typer.Argument(help="The world file. [default: a room with four tags]", metavar="FILE")
    ] = None,
    folder: Annotated[
        Path | None,
        typer.Option("--folder", help="For serial ports and traces. [default: /tmp/pebble-world-…]", metavar="PATH"),
    ] = None,
    trace: Annotated[bool, typer.Option("--trace", help="Record what the MCUs receive.")] = False,
    control: Annotated[bool, typer.Option("--control", help="Read commands from standard input.")] = False,
) -> int:
    """Robots in a room with walls and AprilTags, which their cameras see, until Ctrl-C.

    It prints the serial port and the camera of each robot for its config.

    \b
        pebble sim world
        pebble sim world world.json --folder /tmp/world
    """
    from pebble.simulation.world.program import ROOM, main

    flags = [*(["--trace"] if trace else []), *(["--control"] if control else [])]
    return main([str(file or ROOM), *(["--folder", str(folder)] if folder else []), *flags])


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
    from pebble.demo.main import run

    return run(seconds, for_phones=phone)


def _serial(kind: str, link: Path | None, charging: bool, *options: str) -> int:
    import tempfile

    from pebble.simulation.mcu import main

    path = Path(tempfile.gettempdir(), f"pebble-{kind}") if link is None else link
    typer.echo(f"{kind} is at {path}; Ctrl-C ends it")
    return main(["--kind", kind, "--link", str(path), *(["--charging"] if charging else []), *options])


def _wireless(kind: str, id_: str | None, broker: str, password_file: Path | None, ca_cert: Path | None) -> int:
    from pebble.contract.identity import Identity
    from pebble.simulation.networked import run

    address, config = _address(broker, password_file, ca_cert)
    identity = Identity("pebble", "robots", id_ or kind)
    if config is not None:
        identity = Identity(config.robot.system, config.robot.type, id_ or config.robot.id)
    typer.echo(f"{identity} connects to the broker at {address}; Ctrl-C ends it")
    if config is None:
        return run(kind, identity, address)
    return run(kind, identity, address, name=config.robot.name or "", security=config.security)


def _address(broker: str, password_file: Path | None, ca_cert: Path | None) -> tuple[BrokerAddress, Config | None]:
    """The broker that a URL or a config file names, and the config. Raises PebbleError."""
    from pebble.client.connection import password
    from pebble.client.url import UrlError, settings_of
    from pebble.config import load
    from pebble.errors import PebbleError
    from pebble.runtime.connections import LOCAL_RECONNECT_S, mqtt_settings
    from pebble.simulation.wireless import BrokerAddress
    from pebble.transports import MqttSettings, ZenohSettings

    settings: MqttSettings | ZenohSettings
    config = None
    if "://" not in broker and not broker.startswith("zenoh:"):
        config = load(Path(broker))
        settings = mqtt_settings(config.local_mqtt, reconnect_max_s=LOCAL_RECONNECT_S)
    else:
        try:
            _, settings = settings_of(broker, password=password(password_file), ca_cert=ca_cert)
        except UrlError as error:
            raise UrlError(str(error).replace("--url", "--broker")) from None
    if not isinstance(settings, MqttSettings):
        raise PebbleError("--broker: robots with Wi-Fi use MQTT only: mqtt://HOST[:PORT]")
    if any(port != settings.port for _, port in settings.hosts):
        raise PebbleError("--broker: robots with Wi-Fi use one port for all hosts")
    tls = settings.tls
    return (
        BrokerAddress(
            host=tuple(host for host, _ in settings.hosts) or settings.host,
            port=settings.port,
            username=settings.username,
            password=settings.password,
            tls=tls is not None,
            ca=None if tls is None else tls.ca_cert,
        ),
        config,
    )


def register(app: typer.Typer) -> None:
    group = typer.Typer(help=_GROUP_HELP, rich_markup_mode=None)
    for command in (goob, fred, goob_imu, outlets, minilamp, benjr, fleet, world, loudspeaker):
        group.command(command.__name__)(command)
    app.add_typer(group, name="sim")
