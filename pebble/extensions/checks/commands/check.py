"""``pebble check``: all problems of a config at once, or a summary of it."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple

import typer

from pebble.config import Config, Mqtt, load, resolved
from pebble.config.rules.doors import place_of
from pebble.config.rules.exposure import connections
from pebble.config.secret_text import shown_user, without_secrets
from pebble.config.transport import ZenohClient
from pebble.config.visible import shown
from pebble.contract import CHANNELS, MEDIA_STATUS, STATUS, TOUCH_SENSORS, Channel
from pebble.contract.serial_protocols import SERIAL_PROTOCOLS
from pebble.errors import ConfigError, TransportError
from pebble.extension import Facts, call, lacking_packages, programs_of
from pebble.launcher.programs import programs
from pebble.runtime.addresses import Addresses
from pebble.runtime.connections import check_connections, tls_settings
from pebble.runtime.output import console
from pebble.runtime.process import view_of

if TYPE_CHECKING:
    from rich.table import Table

SCHEMA = "schema.json"  # in the folder of configs, so `configs/*.json` includes it
_LAUNCHER = "launcher"
_MEDIA = {
    "camera_publisher": "video_publisher",
    "audio_publisher": "audio_publisher",
    "audio_receiver": "audio_receiver",
}
#: Channels of these processes that no config can rename.
_NEVER_RENAMED = {_LAUNCHER: STATUS, "av_daemon": MEDIA_STATUS}


def check(
    configs: Annotated[
        list[Path] | None, typer.Argument(help="Config files.", metavar="CONFIG…", show_default=False)
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print only the keys and their values.")] = False,
    keys: Annotated[bool, typer.Option("--keys", help="Print what each key means, and its default.")] = False,
) -> int:
    """Report all mistakes of a config at once, or print a summary of it.

    \b
        pebble check configs/goob.json
        pebble check configs/*.json
        pebble check --json configs/goob.json | jq .services.mqtt_bridge.heartbeat
        pebble check --keys | grep recorder
    """
    if keys:
        from pebble.extensions.checks.keys import keys_text  # few checks need it

        typer.echo(keys_text(), nl=False)
        return 0
    if not configs:
        raise typer.BadParameter("name a config", param_hint="CONFIG…")
    good = [_check(path, as_json=as_json, first=path is configs[0]) for path in configs]
    return 0 if all(good) else 1


def _check(path: Path, *, as_json: bool, first: bool) -> bool:
    """Print a config's summary or its problems; return False if it has problems. schema.json is skipped."""
    if path.name == SCHEMA:
        typer.echo(f"pebble: {path.name}: the JSON Schema of configs, not a config", err=True)
        return True
    try:
        config = load(path)
        check_connections(config)
        _check_certificates(config)
        with_facts = [] if as_json else [extension for extension in config.installed if extension.facts]
        extension_facts = [call(extension, "facts", Facts, config) for extension in with_facts]
    except ConfigError as error:
        for problem in error.problems:
            line = problem if f"{path.name}: " in problem else f"{path.name}: {problem}"
            typer.echo(f"pebble: {without_secrets(line)}", err=True)
        return False
    if as_json:
        typer.echo(json.dumps(resolved(config), indent=2))
        return True
    if not first:
        typer.echo()
    _print(config, path, extension_facts)
    return True


def _check_certificates(config: Config) -> None:
    """Raise ConfigError for TLS files that a connection in use would refuse."""
    problems = []
    for path, section in connections(config):
        place = ".".join(map(str, path))
        settings = tls_settings(section.tls) if isinstance(section, Mqtt | ZenohClient) else None
        if settings is None:
            continue
        from pebble.transports.credentials import make_context  # ssl, which few configs need

        try:
            make_context(settings)
        except TransportError as error:
            problems.append(f"{place}.{error}")
    if problems:
        raise ConfigError(problems)


def _print(config: Config, path: Path, extension_facts: list[Facts]) -> None:
    from rich.padding import Padding
    from rich.table import Table
    from rich.text import Text

    output = console()

    def print_grid(name_style: str, rows: Iterable[tuple[str, ...]], above: int = 1) -> None:
        grid = Table.grid(padding=(0, 2))
        for name, *more in rows:
            grid.add_row(Text(name, style=name_style), *map(Text, more))
        if grid.row_count:
            output.print(Padding(grid, (above, 0, 0, 2), expand=False))

    output.print(Text.assemble((config.base, "bold"), f"  {path}"))
    print_grid("dim", facts(config, extension_facts), above=0)
    if config.robot.platform == "linux":
        output.print(Padding(_topics_table(config), (1, 0, 0, 2), expand=False))
    # These may have names of folders, in which ``shown`` replaces control characters.
    print_grid("dim", [tuple(map(shown, row)) for added in extension_facts for row in added.table])
    print_grid("yellow", [("warning", warning) for warning in (*config.warnings, *_packages(config))])


def _topics_table(config: Config) -> Table:
    """Return a table of the topics of each process."""
    from rich.table import Table
    from rich.text import Text

    table = Table(box=None, pad_edge=False, header_style="dim", padding=(0, 1, 0, 0))
    for name in ("process", "", "topic"):
        table.add_column(name, overflow="fold")
    table.add_column("qos", justify="right")
    table.add_column("retained")
    for process, lines in topics_of(config):
        for number, line in enumerate(lines):
            table.add_row(
                "" if number else Text(process, style="bold"),
                "subscribes" if line.channel.direction == "incoming" else "publishes",
                Text(line.topic, style="yellow") if line.renamed else Text(line.channel.suffix),
                str(line.qos),
                "yes" if line.retained else "",
            )
    return table


def _packages(config: Config) -> Iterator[str]:
    """Yield a line for each extension of this robot whose packages this Python lacks."""
    for extension in config.installed:
        missing = lacking_packages(extension)
        if missing and programs_of([extension], config):
            install = f'pip install "{extension.package}[{extension.extra}]"'
            yield f"{extension.name} does not run without {' and '.join(missing)}: {install}"


class TopicLine(NamedTuple):
    """A channel of a process, with the topic that the config gives it."""

    channel: Channel
    topic: str
    qos: int
    retained: bool
    renamed: bool


def facts(config: Config, extension_facts: Iterable[Facts]) -> list[tuple[str, str]]:
    """Return the transport, the connections and the processes, line by line, without secrets."""
    if config.robot.platform != "linux":
        firmware = f"runs on its own MCU ({config.robot.platform}), not with `pebble up`"
        return [("platform", firmware), ("broker", _mqtt(config.local_mqtt)), *_scripts(config)]
    lines = [("transport", _transport(config)), *_security(config)]
    if config.transport.mqtt_mirror is not None:
        lines.append(("mirror", _mqtt(config.transport.mqtt_mirror)))
    if config.services.mqtt_bridge.enabled:
        lines.append(("uplink", _uplink(config)))
    for added in extension_facts:
        lines += added.lines
    lines += _scripts(config)
    lines += [("serial", line) for line in _serial_lines(config)]
    memories = (config.hall_memory(line) for line in config.motor_lines().values())
    lines += [("for the original's scripts", f"hall samples in the shared memory {name}") for name in memories if name]
    names = [program.name for program in programs(config) if not program.on_demand]
    lines.append(("processes", ", ".join([_LAUNCHER, *names])))
    if on_request := [program.name for program in programs(config) if program.on_demand]:
        lines.append(("on request", ", ".join(on_request)))
    if off := list(_off(config)):
        lines.append(("off", ", ".join(off)))
    return lines


def _off(config: Config) -> Iterator[str]:
    """Yield the services that have settings in the config but are not enabled."""
    bridge = config.services.serial_mcu_bridge
    lines = {"serial_mcu_bridge": bridge}
    lines |= {f"serial_mcu_bridge:{name}": line for name, line in bridge.instances.items()}
    for name, line in lines.items():
        if not line.enabled and line.serial.port is not None:
            yield f"{name} (its section has a port)"
    for name in config.services.__struct_fields__:
        section = getattr(config.services, name)
        if name != "serial_mcu_bridge" and not getattr(section, "enabled", True) and section != type(section)():
            yield f"{name} (its section has settings)"


def topics_of(config: Config) -> Iterator[tuple[str, list[TopicLine]]]:
    """Yield each process that has topics, with its topics."""
    for name in (_LAUNCHER, *(program.name for program in programs(config))):
        service, _, instance = name.partition(":")
        lines = _lines(view_of(config, instance), service)
        if lines:
            yield name, lines


def _lines(config: Config, service: str) -> list[TopicLine]:
    """Return the topics of a service's process: those with a key that may rename them, and one without, if any."""
    addresses = Addresses(config)
    channels = [channel for channel in CHANNELS if _is_of(channel, service) or channel is _NEVER_RENAMED.get(service)]
    if service == "serial_mcu_bridge":
        channels = [channel for channel in channels if _is_of_serial_line(channel, config)]
    lines: list[TopicLine] = []
    for channel in channels:
        topic, qos, retained = addresses[channel]
        lines.append(TopicLine(channel, topic, qos, retained, renamed=topic != channel.topic(config.base)))
    return lines


def _is_of(channel: Channel, service: str) -> bool:
    """True if the service publishes or receives the channel: its section of the config has the key that renames it."""
    path = channel.override or ""
    if service in _MEDIA:
        return path == f"services.mqtt_bridge.media.{_MEDIA[service]}.topic"
    return path.startswith(f"services.{service}.") and ".media." not in path


def _is_of_serial_line(channel: Channel, config: Config) -> bool:
    line = config.services.serial_mcu_bridge
    if channel is TOUCH_SENSORS and not line.telemetry.publish_touch_sensors:
        return False
    is_sensor, drives = channel.metric.startswith("sensors/"), SERIAL_PROTOCOLS[line.protocol].drives
    return is_sensor != drives  # a board that drives has the other topics, any other board only these


def _transport(config: Config) -> str:
    kind = config.transport.kind
    if kind == "mqtt":
        return f"mqtt, {_mqtt(config.local_mqtt)}"
    journal = config.transport.journal
    retained = "retained messages in memory" if journal is None else f"retained messages in {journal}"
    return f"{kind}, run directory {config.run_dir()}, {retained}"


def _uplink(config: Config) -> str:
    bridge = config.services.mqtt_bridge
    if bridge.remote is not None and bridge.remote.kind != "mqtt":
        ways = [f"listens on {endpoint}" for endpoint in bridge.remote.listen]
        ways += [f"connects to {endpoint}" for endpoint in bridge.remote.connect]
        return ", ".join([bridge.remote.kind, *ways])
    return f"mqtt, {_mqtt(bridge.remote_mqtt)}"


def _scripts(config: Config) -> list[tuple[str, str]]:
    """Return a warning if others may use the broker of the robot's own processes: they can pose as a script."""
    shared = _shared_broker(config)
    if shared is None:
        return []
    return [("scripts", f"anybody at broker {shared.host}:{shared.port} may pose as one, or end one")]


def _shared_broker(config: Config) -> Mqtt | None:
    """Return the broker that other programs, too, may use to reach the robot's own processes; None if there is none.

    With Zenoh inside it is that of the mirror. With MQTT inside it is the local one if operators use it, too: there
    is no bridge, or it does not lead to another broker or to a hub.
    """
    if config.transport.kind != "mqtt":
        return config.transport.mqtt_mirror
    bridge = config.services.mqtt_bridge
    is_zenoh_uplink = bridge.remote is not None and bridge.remote.kind != "mqtt"
    is_elsewhere = is_zenoh_uplink or place_of(bridge.remote_mqtt) != place_of(config.local_mqtt)
    return None if bridge.enabled and is_elsewhere else config.local_mqtt


def _mqtt(mqtt: Mqtt) -> str:
    user = "anonymous" if mqtt.username is None else f"user {shown_user(mqtt.username)}"
    password = "" if mqtt.username is None or mqtt.password is None else ", password ***"
    name = " without a check of the name" if mqtt.tls.insecure else ""
    tls = f"TLS{name}" if mqtt.tls.enabled else "not encrypted"
    return f"{mqtt.host}:{mqtt.port}, MQTT {mqtt.protocol}, {user}{password}, {tls}"


def _security(config: Config) -> Iterator[tuple[str, str]]:
    if config.security.level != "open":
        who = {"drive": "may drive, too", "free": "may drive while nobody has control", "refuse": "may not drive"}
        yield "security", f"level {config.security.level}; who has no control {who[config.security.unnamed]}"


def _serial_lines(config: Config) -> Iterator[str]:
    for name, line in config.serial_instances().items():
        label = f"{name}: " if name else ""
        drives = SERIAL_PROTOCOLS[line.protocol].drives
        stop = f", stops {line.safety.drive_timeout_seconds:g} s after the last command" if drives else ""
        yield f"{label}{line.protocol} at {line.serial.port}, {line.serial.baud} baud{stop}"
