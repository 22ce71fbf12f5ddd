"""Warns when the config file no longer says what the robot runs with."""

import logging
from pathlib import Path

from pebble.config import Config, load
from pebble.errors import ConfigError

log = logging.getLogger(__name__)


class ConfigWatch:
    """Looks at the file of a running robot's config: call :meth:`poll` regularly. It warns once."""

    def __init__(self, config: Config) -> None:
        self._config = config
        self._judged = self._seen = _version(config.path)
        self._warned = False

    def poll(self) -> None:
        """Judge a file that has changed, and has not changed since the last call: by then it is complete."""
        before, self._seen = self._seen, _version(self._config.path)
        if self._warned or self._seen == self._judged or self._seen != before:
            return
        self._judged = self._seen
        difference = self._difference()
        if difference is not None:
            self._warned = True
            log.warning(
                "%s has changed: the robot goes on with what it read when it started, until its next start%s",
                self._config.path, difference,
            )  # fmt: skip

    def _difference(self) -> str | None:
        """What to add to the warning; None if the file means the same."""
        try:
            return None if load(self._config.path or "") == self._config else ""
        except ConfigError as error:
            return f"; its next start would fail: {error.problems[0]}"
        except Exception as error:  # noqa: BLE001 - nothing that is in a file may end a running robot
            return f"; its next start would fail: {error}"


def _version(path: Path | None) -> tuple[int, ...]:
    """Differs whenever the file has been written, replaced or removed."""
    try:
        found = (path or Path()).stat()
    except OSError:
        return ()
    return found.st_ino, found.st_size, found.st_mtime_ns
