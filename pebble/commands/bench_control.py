"""``pebble bench control`` and ``pebble bench echo``: service to service, on this machine and between two."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, TypeVar

import typer

from pebble.bench.output import FOLDER
from pebble.errors import PebbleError
from pebble.transports import MqttSettings

_Number = TypeVar("_Number", int, float)
_Variants = Annotated[str | None, typer.Option(help="Some of them, separated by commas.", metavar="NAMES")]
_Sizes = Annotated[str | None, typer.Option(help="Bytes, for example 40,1024.", metavar="BYTES")]
_Rates = Annotated[str | None, typer.Option(help="Messages a second, for example 20,200.", metavar="HZ")]
_Loads = Annotated[str | None, typer.Option(help="Of none, media and hog.", metavar="NAMES")]
_Password = Annotated[Path | None, typer.Option(help="Holds the broker's password.", metavar="FILE")]
_Ca = Annotated[Path | None, typer.Option(help="Certificate authority of an mqtts broker.", metavar="FILE")]


def control(
    variants: _Variants = None,
    sizes: _Sizes = None,
    rates: _Rates = None,
    loads: _Loads = None,
    seconds: Annotated[float | None, typer.Option(help="Length of one slice of a round.")] = None,
    rounds: Annotated[int | None, typer.Option(min=1, help="How often everything is run. [default: 10]")] = None,
    quick: Annotated[bool, typer.Option("--quick", help="Few conditions and short slices.")] = False,
    null: Annotated[
        bool, typer.Option("--null", help="One variant against itself, and against itself made a fifth slower.")
    ] = False,
    far: Annotated[
        str | None, typer.Option(help="Against `pebble bench echo` on another machine.", metavar="URL")
    ] = None,
    password_file: _Password = None,
    ca_cert: _Ca = None,
    output: Annotated[Path, typer.Option(help="Folder for results and plots.", metavar="FOLDER")] = FOLDER,
) -> int:
    """Messages from one service to another and back: MQTT and Zenoh, alone, beside pictures, beside a busy process.

    Two processes for each variant, a broker or hub of its own, all of them new in every round. Needs mosquitto.
    With --null: one variant (zenoh-p2p), 40 B at 200 Hz. It fails if the comparison sees a difference where there is
    none, or misses the one that was planted.

    \b
        pebble bench control
        pebble bench control --variants mqtt,zenoh-p2p --sizes 40 --rates 200 --rounds 20
        pebble bench control --null --variants mqtt
        pebble bench control --far mqtt://broker.local
    """
    numbers = [_number(size, int, "--sizes") for size in _names(sizes) or ()] or None
    speeds = [_number(rate, float, "--rates") for rate in _names(rates) or ()] or None
    if far is not None:
        from pebble.bench.control_far import FarPlan, measure

        _refuse_with_far(variants=variants, loads=loads, null=null or None)
        plan = FarPlan.of(sizes=numbers, rates=speeds, seconds=seconds, rounds=rounds, quick=quick, output=output)
        return measure(plan, _settings(far, password_file, ca_cert))
    from pebble.bench.control import run
    from pebble.bench.control_plan import Plan

    return run(
        Plan.of(
            variants=_names(variants),
            sizes=numbers,
            rates=speeds,
            loads=_names(loads),
            seconds=seconds,
            rounds=rounds,
            quick=quick,
            null=null,
            output=output,
        )
    )


def echo(
    url: Annotated[str, typer.Argument(help="mqtt://HOST[:PORT] or mqtts://HOST[:PORT]", show_default=False)],
    password_file: _Password = None,
    ca_cert: _Ca = None,
) -> int:
    """Send back what `pebble bench control --far` sends, until Ctrl-C. Runs on the other machine.

    \b
        pebble bench echo mqtt://broker.local
    """
    from pebble.bench.control_far import serve

    return serve(_settings(url, password_file, ca_cert))


def _settings(url: str, password_file: Path | None, ca_cert: Path | None) -> MqttSettings:
    from pebble.commands.connection import password
    from pebble.commands.url import settings_of

    _, settings = settings_of(url, password=password(password_file), ca_cert=ca_cert)
    if not isinstance(settings, MqttSettings):
        raise PebbleError(f"{url}: another machine is reached over MQTT: mqtt://HOST[:PORT] or mqtts://HOST[:PORT]")
    return settings


def _refuse_with_far(**options: str | bool | None) -> None:
    for name, value in options.items():
        if value is not None:
            raise PebbleError(f"--{name} has no use with --far: there is one variant, between two machines")


def _names(text: str | None) -> list[str] | None:
    return None if text is None else [name.strip() for name in text.split(",") if name.strip()]


def _number(text: str, kind: Callable[[str], _Number], option: str) -> _Number:
    try:
        return kind(text)
    except ValueError:
        raise PebbleError(f"{option}: {text} is no such number") from None


def register(group: typer.Typer) -> None:
    """Add the commands of this file."""
    group.command("control")(control)
    group.command("echo")(echo)
