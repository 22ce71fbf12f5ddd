"""The options that select where a command connects."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pebble.errors import PebbleError
from pebble.extensions.operator.commands.options import (
    CaCert,
    ConfigOption,
    PasswordFile,
    RemoteOption,
    RobotOption,
    UrlOption,
)

if TYPE_CHECKING:
    from pebble.transports import MqttSettings


def _option(name: str, option: Any, default: object = None) -> inspect.Parameter:
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=option)


_CONNECTION = (_option("config", ConfigOption), _option("url", UrlOption))
_ROBOT = (_option("robot", RobotOption),)
_REMOTE = (_option("remote", RemoteOption, default=False),)
_CREDENTIALS = (_option("password_file", PasswordFile), _option("ca_cert", CaCert))


def with_target(*, program: str = "tool", robot: bool = False) -> Callable[[Callable[..., int]], Callable[..., int]]:
    """Decorate a command with the options that select where to connect; it gets them as ``target``.

    In the help they stand in the place of ``target``, but for those of password and certificate, which come last.
    ``program``: part of the client id. ``robot``: add --robot, for a command that has no argument for the robot.
    """
    options = (*_CONNECTION, *(_ROBOT if robot else ()), *_REMOTE)

    def decorate(command: Callable[..., int]) -> Callable[..., int]:
        """Return ``run``, which has these options in the place of ``target``, and calls ``command``."""

        @functools.wraps(command)
        def run(**given: Any) -> int:
            from pebble.extensions.operator.client.connection import (
                Target,  # not all commands that use this module connect
            )

            for value in given.values() if robot else ():
                if isinstance(value, str) and value.endswith(".json") and Path(value).is_file():
                    raise PebbleError(f"{value} is a config file: use -c {value}")
            target = {option.name: given.pop(option.name) for option in (*options, *_CREDENTIALS)}
            return command(**given, target=Target(**target, program=program))

        signature = inspect.signature(command, eval_str=True)  # typer reads run.__signature__ and run.__annotations__
        declared = list(signature.parameters.values())
        at = list(signature.parameters).index("target")
        parameters = [*declared[:at], *options, *declared[at + 1 :], *_CREDENTIALS]
        run.__signature__ = signature.replace(parameters=parameters)  # type: ignore[attr-defined]
        run.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
        return run

    return decorate


def broker_of(option: str, url: str, password_file: Path | None, ca_cert: Path | None) -> MqttSettings:
    """Return the settings of the MQTT broker that an option names. Raises PebbleError."""
    # not all commands that use this module connect
    from pebble.extensions.operator.client.url import FORMS, UrlError, settings_of
    from pebble.transports import MqttSettings

    forms = "mqtt://HOST[:PORT] or mqtts://…"
    try:
        _, settings = settings_of(url, password_file=password_file, ca_cert=ca_cert)
    except UrlError as error:
        raise UrlError(str(error).replace("--url", option).replace(FORMS, forms)) from None
    if not isinstance(settings, MqttSettings):
        raise UrlError(f"{option} must be {forms}")
    return settings
