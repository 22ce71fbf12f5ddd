"""The robots that were here before, so that those who invent others cannot push them out; kept in a database."""

import asyncio
import logging
from collections.abc import Coroutine, Iterator
from typing import Any, NamedTuple

from pebble.client.rank import Rank
from pebble.client.robot_view import RobotView
from pebble.fleet.database import DatabaseError
from pebble.fleet.people import People

log = logging.getLogger(__name__)

MAX_KNOWN = 256
_REMEMBERED_DAYS = 30  # without a sign of it, after which one that only was there gives way to another
_OPERATED, _SEEN = "operated", "seen"
_KEY = "known "  # what a setting of the server begins with; then the robot


class _Entry(NamedTuple):
    operated: bool  # people have moved it from here, which no message of a stranger does
    day: int  # since 1970, the newest on which it was there

    def __str__(self) -> str:
        return f"{_OPERATED if self.operated else _SEEN} {self.day}"


class KnownRobots:
    """Robots by base topic. A new one takes no place of those that people have operated, nor of those seen lately."""

    def __init__(self, saved: dict[str, str]) -> None:
        self._entries = {ref: entry for ref, text in saved.items() if (entry := _parsed(text)) is not None}
        self._unsaved: dict[str, str | None] = {ref: None for ref in saved if ref not in self._entries}
        while len(self._entries) > MAX_KNOWN:
            self._remove(min(self._entries, key=self._entries.__getitem__))

    def __contains__(self, ref: object) -> bool:
        return ref in self._entries

    def __iter__(self) -> Iterator[str]:
        return iter(self._entries)

    def __len__(self) -> int:
        return len(self._entries)

    def operated(self, ref: str, day: int) -> None:
        self._note(ref, _Entry(operated=True, day=day))

    def seen(self, robot: RobotView, rank: Rank, day: int) -> None:
        """It is there; what neither drives nor can be stopped is not remembered."""
        if rank.live and rank.has_capabilities and (robot.estop.available or robot.drives):
            operated = robot.base in self._entries and self._entries[robot.base].operated
            self._note(robot.base, _Entry(operated=operated, day=day))

    def changes(self) -> dict[str, str | None]:
        """What has to be saved since the last call; None: it is no longer remembered."""
        changes, self._unsaved = self._unsaved, {}
        return changes

    def _note(self, ref: str, new: _Entry) -> None:
        if self._entries.get(ref) == new:
            return
        if ref not in self._entries and len(self._entries) >= MAX_KNOWN:
            first = min(self._entries, key=self._entries.__getitem__)
            operated, day = self._entries[first]
            if not new.operated and (operated or day >= new.day - _REMEMBERED_DAYS):
                return
            self._remove(first)
        self._entries[ref] = new
        self._unsaved[ref] = str(new)

    def _remove(self, ref: str) -> None:
        del self._entries[ref]
        self._unsaved[ref] = None


def _parsed(text: str) -> _Entry | None:
    how, _, day = text.partition(" ")
    return _Entry(how == _OPERATED, int(day)) if how in (_OPERATED, _SEEN) and day.isdecimal() else None


class SavedRobots:
    """Keeps the robots that were here before in the server's database; ``robots`` are those that are known."""

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
