"""Arguments and options that several commands share."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pebble.errors import PebbleError

if TYPE_CHECKING:
    from pebble.transports import MqttSettings

ConfigArgument = Annotated[Path, typer.Argument(help="A robot's config file.", metavar="CONFIG", show_default=False)]
ConfigOption = Annotated[
    Path | None, typer.Option("--config", "-c", help="A robot's config file: use its own transport.", metavar="CONFIG")
]
RobotArgument = Annotated[
    str,
    typer.Argument(
        help="A robot's config file, or with --url or --config its id.", metavar="ROBOT", show_default=False
    ),
]
UrlOption = Annotated[
    str | None, typer.Option(help="mqtt://[USER@]HOST[:PORT], mqtts://… or zenoh:RUN_DIR.", metavar="URL")
]
BrokerUrl = Annotated[
    str | None, typer.Option(help="mqtt://[USER@]HOST[:PORT] or mqtts://… of the robots' broker.", metavar="URL")
]
RemoteOption = Annotated[
    bool, typer.Option("--remote", help="With --config: the operators' remote broker, not the robot's local transport.")
]
PasswordFile = Annotated[
    Path | None, typer.Option(help="File with the broker's password; else $PEBBLE_PASSWORD.", metavar="FILE")
]
CaCert = Annotated[Path | None, typer.Option(help="Certificate authority to trust with mqtts://.", metavar="FILE")]
RobotOption = Annotated[
    str | None, typer.Option("--robot", "-r", help="The robot that short names refer to.", metavar="[SYSTEM/TYPE/]ID")
]
RootOption = Annotated[
    Path, typer.Option("--root", help="Folder that stands for / where the robot is installed.", metavar="DIR")
]
Output = Annotated[Path, typer.Option("--output", help="Folder for results and plots.", metavar="FOLDER")]
Quick = Annotated[bool, typer.Option("--quick", help="Few cases and short rounds; results are marked as quick.")]


def _option(name: str, option: Any, default: object = None) -> inspect.Parameter:
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=option)


_CONNECTION = (_option("config", ConfigOption), _option("url", UrlOption))
_ROBOT = (_option("robot", RobotOption),)
_REMOTE = (_option("remote", RemoteOption, default=False),)
_CREDENTIALS = (_option("password_file", PasswordFile), _option("ca_cert", CaCert))


def with_target(*, program: str = "tool", robot: bool = False) -> Callable[[Callable[..., int]], Callable[..., int]]:
    """Give a command the options that select where to connect, and pass them to it as its keyword ``target``.

    They take the place of this parameter; the password and the certificate authority come last. ``robot``: there is an
    option --robot, too, where no argument of the command names a robot.
    """
    options = (*_CONNECTION, *(_ROBOT if robot else ()), *_REMOTE)

    def decorate(command: Callable[..., int]) -> Callable[..., int]:
        @functools.wraps(command)
        def run(**given: Any) -> int:
            from pebble.client.connection import Target  # not all commands that use this module connect

            target = {one.name: given.pop(one.name) for one in (*options, *_CREDENTIALS)}
            return command(**given, target=Target(**target, program=program))

        signature = inspect.signature(command, eval_str=True)
        own = list(signature.parameters.values())
        at = list(signature.parameters).index("target")
        parameters = [*own[:at], *options, *own[at + 1 :], *_CREDENTIALS]
        run.__signature__ = signature.replace(parameters=parameters)  # type: ignore[attr-defined]
        run.__annotations__ = {one.name: one.annotation for one in parameters}
        return run

    return decorate


def broker_of(option: str, url: str, password_file: Path | None, ca_cert: Path | None) -> MqttSettings:
    """Return the settings of the MQTT broker that an option names. Raises PebbleError."""
    from pebble.client.url import FORMS, UrlError, settings_of  # not all commands that use this module connect
    from pebble.config.text_files import password
    from pebble.transports import MqttSettings

    forms = "mqtt://HOST[:PORT] or mqtts://…"
    try:
        _, settings = settings_of(url, password=password(password_file), password_file=password_file, ca_cert=ca_cert)
    except UrlError as error:
        raise UrlError(str(error).replace("--url", option).replace(FORMS, forms)) from None
    if not isinstance(settings, MqttSettings):
        raise UrlError(f"{option} must be {forms}")
    return settings


def host_of(option: str, text: str, parse: Callable[[str], str] | None = None) -> str:
    """The host that an option names. Raises PebbleError."""
    from pebble.config import hosts  # not all commands that use this module have one

    try:
        return (parse or hosts.host)(text)
    except hosts.HostError as error:
        raise PebbleError(f"{option} {error}") from None


def split_names(text: str) -> list[str]:
    """The names in ``a,b, c``. Raises PebbleError if there is none."""
    names = [name.strip() for name in text.split(",") if name.strip()]
    if not names:
        raise PebbleError(f'"{text}" holds no name')
    return names
