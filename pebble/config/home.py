"""Paths in a home folder, which a user of a container or of a service may not have."""

from pathlib import Path

from pebble.errors import ConfigError


def in_home(path: str | Path) -> Path:
    """Return ``path`` with a ``~`` at its beginning replaced.

    Raises ConfigError where that folder is not known: there is no HOME, and no entry for this user or for that name.
    """
    try:
        return Path(path).expanduser()
    except RuntimeError:
        raise ConfigError(
            f"{path}: the home folder is not known; set HOME, or write a whole path for it in the config"
        ) from None
