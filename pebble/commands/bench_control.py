"""``pebble bench control`` and ``pebble bench echo``: service to service, on this machine and between two."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, TypeVar

import typer

from pebble.bench.comparison import FOLDER
from pebble.commands.options import CaCert, Output, PasswordFile, Quick, split_names
from pebble.errors import PebbleError
from pebble.transports import MqttSettings

_Number = TypeVar("_Number", int, float)
_Variants = Annotated[str | None, typer.Option(help="Some of them, separated by commas.", metavar="NAMES")]
_Sizes = Annotated[str | None, typer.Option(help="Bytes, for example 40,1024.", metavar="BYTES")]
_Rates = Annotated[str | None, typer.Option(help="Messages a second, for example 20,200.", metavar="HZ")]
_Loads = Annotated[str | None, typer.Option(help="Some of none, media and hog.", metavar="NAMES")]


def control(
    variants: _Variants = None,
    sizes: _Sizes = None,
    rates: _Rates = None,
    loads: _Loads = None,
    seconds: Annotated[float | None, typer.Option(help="Duration of one case in a round.")] = None,
    rounds: Annotated[int | None, typer.Option(min=1, help="Rounds of all cases. [default: 10]")] = None,
    quick: Quick = False,
    null: Annotated[
        bool, typer.Option("--null", help="One variant against itself, and against itself slowed by a fifth.")
    ] = False,
    far: Annotated[
        str | None, typer.Option(help="Measure against `pebble bench echo` on another machine.", metavar="URL")
    ] = None,
    password_file: PasswordFile = None,
    ca_cert: CaCert = None,
    output: Output = FOLDER,
) -> int:
    """Round trips between two services: MQTT and Zenoh, on an idle machine, with camera frames, with a busy process.

    Each round starts two processes and a broker or hub for each variant. Needs mosquitto.
    With --null: one variant (zenoh-p2p), 40 B at 200 Hz. The run fails if it finds a difference where there is none,
    or misses the planted one.

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
    from pebble.bench.control_plan import ControlPlan

    return run(
        ControlPlan.of(
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
    password_file: PasswordFile = None,
    ca_cert: CaCert = None,
) -> int:
    """Send back what `pebble bench control --far` sends, until Ctrl-C. Runs on the other machine.

    \b
        pebble bench echo mqtt://broker.local
    """
    from pebble.bench.control_far import serve

    return serve(_settings(url, password_file, ca_cert))


def _settings(url: str, password_file: Path | None, ca_cert: Path | None) -> MqttSettings:
    from pebble.client.connection import password
    from pebble.client.url import settings_of

    _, settings = settings_of(url, password=password(password_file), ca_cert=ca_cert)
    if not isinstance(settings, MqttSettings):
        raise PebbleError(f"{url}: between machines only MQTT is measured: mqtt://HOST[:PORT] or mqtts://HOST[:PORT]")
    return settings


def _refuse_with_far(**options: str | bool | None) -> None:
    for name, value in options.items():
        if value is not None:
            raise PebbleError(f"--{name} has no use with --far: there is one variant, between two machines")


def _names(text: str | None) -> list[str] | None:
    return None if text is None else split_names(text)


def _number(text: str, kind: Callable[[str], _Number], option: str) -> _Number:
    try:
        return kind(text)
    except ValueError:
        raise PebbleError(f"{option}: {text} is not a number of this kind") from None


COMMANDS = (control, echo)
