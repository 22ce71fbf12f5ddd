"""Finds the secrets in a config, by their keys and in its texts as secret_text does, and hides them."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any, TypeVar

from msgspec.structs import fields

from pebble.config.secret_text import HIDDEN, is_secret, is_secret_option, shown_user, without_secrets
from pebble.config.types import Secret, Section

_HARMLESS = ("password_file", "password_env")

Value = TypeVar("Value")


def values_of(section: object, kind: type[Value]) -> Iterator[Value]:
    """Yield all values of one kind in a config, such as its secrets, or the files that it names."""
    if isinstance(section, kind):
        yield section
    elif isinstance(section, Section):
        for name in section.__struct_fields__:
            yield from values_of(getattr(section, name), kind)
    elif isinstance(section, dict):
        for item in section.values():
            yield from values_of(item, kind)


def holds_secret(value: Any, key: str = "") -> bool:
    """True if plain data looks as if it holds a secret, judged by its keys and texts."""
    if isinstance(value, dict):
        return any(holds_secret(item, name) for name, item in value.items())
    if isinstance(value, list):
        return any(holds_secret(item, key) for item in value)
    if value in ("", None) or isinstance(value, bool):
        return False
    if is_secret(key) and key not in _HARMLESS:
        return True
    return isinstance(value, str) and without_secrets(value) != value


def masked(value: Any, key: str = "") -> Any:
    """Return a value of a config as plain data that anybody may see. Keys that are not set are left out."""
    if isinstance(value, Secret) or (is_secret(key) and key not in _HARMLESS and value is not None):
        return HIDDEN
    if isinstance(value, Section):
        return _object({field.encode_name: getattr(value, field.name) for field in fields(value)})
    if isinstance(value, dict):
        is_environment = key == "env" or key.endswith("_env")
        return dict.fromkeys(value, HIDDEN) if is_environment else _object(value)
    if isinstance(value, tuple | list) and (key == "command" or key.endswith("_command")):
        return [masked(word) for word in value[:1]] + [HIDDEN] * len(value[1:])  # an argument may be a secret
    if isinstance(value, tuple | list):
        is_option = [isinstance(item, str) and is_secret_option(item) for item in value]
        pairs = zip(value, [False, *is_option], strict=False)  # each with: does it follow an option such as --token?
        return [HIDDEN if follows_option else masked(item, key) for item, follows_option in pairs]
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, str):
        return shown_user(value) if key == "username" else without_secrets(value)
    return value


def _object(items: dict[str, Any]) -> dict[str, Any]:
    if is_secret(str(items.get("key", ""))):  # an option of a script
        items = items | {"default": HIDDEN}
    return {without_secrets(key): masked(value, key) for key, value in items.items() if value is not None}
