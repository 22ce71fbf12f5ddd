"""Keeps the robots that were here before in the server's database."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Coroutine
from typing import Any

from pebble.fleet.database import DatabaseError
from pebble.fleet.people import People
from pebble.web.known_robots import KnownRobots

log = logging.getLogger(__name__)

_KEY = "known "  # what a setting of the server begins with; then the robot


class SavedRobots:
    """``robots`` are those that are known."""

    def __init__(self, people: People) -> None:
        self.robots = KnownRobots(people.all(_KEY))
        self._people = people
        self._saving = False

    def save(self) -> Coroutine[Any, Any, None] | None:
        """The work of saving what has changed, to be awaited; None: nothing has, or it goes on."""
        if self._saving or not (changes := self.robots.changes()):
            return None
        self._saving = True
        return self._save(changes)

    async def _save(self, changes: dict[str, str | None]) -> None:
        """On a thread: another process may be writing to the file."""
        try:
            for ref, value in changes.items():
                await asyncio.to_thread(self._people.set, _KEY + ref, value)
        except DatabaseError as error:
            log.warning("which robots are known is not saved: %s", error)
        finally:
            self._saving = False
