"""The picture sources that people have chosen for robots' pages. They apply to everybody, and are stored."""

import logging
from collections.abc import Callable

from pebble.extensions.fleet.database import DatabaseError
from pebble.extensions.fleet.people import People
from pebble.extensions.page import messages as m
from pebble.extensions.page.robots import Robots

log = logging.getLogger(__name__)

_PICTURE = "picture-from "  # begins the key of a setting in the people's database; the component follows


class ChosenSources:
    """The chosen sources. ``on_change`` is called with a component whose page gets another source."""

    def __init__(self, people: People, robots: Robots, on_change: Callable[[str], None]) -> None:
        self._people, self._robots, self._on_change = people, robots, on_change

    def choose(self, ref: str, source: str) -> None:
        """Show the picture of ``source`` on the page of ``ref``; "" means its own picture."""
        if ref in self._robots.components and (not source or source in self._robots.components):
            self._people.set(_PICTURE + ref, "" if source == ref else source)
            self.show(ref)

    def show(self, ref: str) -> None:
        """Send pages the chosen source of this component."""
        try:
            source = self._people.get(_PICTURE + ref)
        except DatabaseError as error:
            log.warning("where the picture of %s comes from is not known: %s", ref, error)
            return
        self._robots.sources.pop(ref, None)
        if source:
            self._robots.sources[ref] = source
        self._on_change(ref)
        self._robots.set_server_metric(ref, "web/picture-from", m.PictureFrom(source=source))
