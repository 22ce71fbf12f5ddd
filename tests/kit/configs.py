"""Parts of configs."""

from typing import Any


def at(path: str, value: Any) -> dict[str, Any]:
    """Return a config with one key set."""
    for key in reversed(path.split(".")):
        value = {key: value}
    tree: dict[str, Any] = value
    return tree
