"""Finds and hides what is secret in a config: passwords, tokens, logins in addresses, values of variables."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from msgspec.structs import fields

from pebble.config.types import Secret, Section

HIDDEN = "***"
_NAMES = "pass|secret|token|credential|(?:api|access|private|auth).?key"
_KEY = re.compile(_NAMES, re.IGNORECASE).search
_HARMLESS = ("password_file", "password_env")
_LOGIN = re.compile(r"(?<=://)[^/?#\s]*(?=@)")  # user:password of a URL
_WORD = re.compile(rf"(\b[\w-]{{0,40}}(?:{_NAMES}|pwd)[\w-]{{0,40}}=)[^&\s]+", re.IGNORECASE)  # of a query or an option


def is_secret(key: str) -> bool:
    """Whether the key's name says that its value, or the file or variable that it names, is secret."""
    return bool(_KEY(key))


def without_secrets(text: str) -> str:
    """``text`` with stars in place of logins in URLs, and of passwords and tokens in queries and options."""
    return _WORD.sub(rf"\1{HIDDEN}", _LOGIN.sub(HIDDEN, text))


def without_login(url: str) -> str:
    """``url`` without its user and password."""
    return re.sub(f"{_LOGIN.pattern}@", "", url)


def holds_secret(value: Any, key: str = "") -> bool:
    """Whether a secret is written in plain data, to tell from its keys and its text."""
    if isinstance(value, dict):
        return any(holds_secret(item, name) for name, item in value.items())
    if isinstance(value, list):
        return any(holds_secret(item, key) for item in value)
    if value in ("", None) or isinstance(value, bool):
        return False
    named = is_secret(key) and key not in _HARMLESS
    return named or (isinstance(value, str) and without_secrets(value) != value)


def masked(value: Any, key: str = "") -> Any:
    """A value of a config as plain data that anybody may see. Keys that are not set are left out."""
    if isinstance(value, Secret) or (is_secret(key) and key not in _HARMLESS and value is not None):
        return HIDDEN
    if isinstance(value, Section):
        return _object({field.encode_name: getattr(value, field.name) for field in fields(value)})
    if isinstance(value, dict):
        variables = key == "env" or key.endswith("_env")  # whatever they are called
        return dict.fromkeys(value, HIDDEN) if variables else _object(value)
    if isinstance(value, tuple | list):
        return [masked(item, key) for item in value]
    if isinstance(value, Path):
        return str(value)
    return without_secrets(value) if isinstance(value, str) else value


def _object(items: dict[str, Any]) -> dict[str, Any]:
    return {key: masked(value, key) for key, value in items.items() if value is not None}
