"""A config as plain data for people to read: everything filled in, nothing secret."""

import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

from msgspec.structs import fields

from pebble.config.types import Secret, Section

if TYPE_CHECKING:
    from pebble.config import Config

_LOGIN = re.compile(r"(?<=://)[^/@\s]*(?=@)")  # user:password of a URL
_SECRET_KEY = re.compile("password|secret|token", re.IGNORECASE)
_HARMLESS = ("password_file", "password_env")


def resolved(config: "Config") -> dict[str, Any]:
    """The keys of the file with every default and inherited value, and under ``derived`` what follows from them.

    JSON can write all of it. Keys that are not set and have no default are left out; secrets read ``***``.
    """
    own = {
        name: _view(getattr(config, name), name)
        for name in ("log_level", "robot", "local_mqtt", "transport", "services", "web_interface")
    }
    return own | {
        "derived": {
            "base": config.base,
            "run_dir": str(config.run_dir()),
            "serial_instances": list(config.serial_instances()),
        }
    }


def _view(value: Any, key: str) -> Any:
    if isinstance(value, Secret) or (_SECRET_KEY.search(key) and key not in _HARMLESS and value is not None):
        return "***"
    if isinstance(value, Section):
        return _object({field.encode_name: getattr(value, field.name) for field in fields(value)})
    if isinstance(value, dict):
        return _object(value)
    if isinstance(value, tuple | list):
        return [_view(item, key) for item in value]
    if isinstance(value, Path):
        return str(value)
    return _LOGIN.sub("***", value) if isinstance(value, str) else value


def _object(items: dict[str, Any]) -> dict[str, Any]:
    return {key: _view(value, key) for key, value in items.items() if value is not None}
