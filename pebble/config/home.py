"""Paths that begin with ``~``. A user of a container or of a service may have no home folder."""

from pathlib import Path

from pebble.errors import ConfigError


def in_home(path: str | Path) -> Path:
    """Return ``path`` with its leading ``~`` or ``~user`` replaced by that user's home folder.

    Raises ConfigError if that folder is not known: there is no HOME, and no entry for the user.
    """
    try:
        return Path(path).expanduser()
    except RuntimeError:
        why = "the home folder is not known; set HOME, or write a whole path for it in the config"
        raise ConfigError(f"{path}: {why}") from None
