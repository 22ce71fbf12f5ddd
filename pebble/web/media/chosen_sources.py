"""Where the picture on a robot's page comes from, if a person has chosen that: for everybody, and remembered."""

import logging
from collections.abc import Callable

from pebble.fleet.database import DatabaseError
from pebble.fleet.people import People
from pebble.web import messages as m
from pebble.web.media.robot_streams import OwnHosts, origin
from pebble.web.robots import Robots

log = logging.getLogger(__name__)

_PICTURE = "picture-from "  # what a setting of the server begins with; then the component
_STREAM = "stream-address "


class ChosenSources:
    """Another component's picture, or the address of a stream; ``on_change`` is called with the component."""

    def __init__(self, people: People, robots: Robots, own_hosts: OwnHosts, on_change: Callable[[str], None]) -> None:
        self.own_hosts = own_hosts
        self._people, self._robots, self._on_change = people, robots, on_change
        robots.streams.update(people.all(_STREAM))

    def choose_picture(self, ref: str, source: str) -> None:
        """Show the picture of ``source`` on the page of ``ref``; "" is its own."""
        if ref in self._robots.components and (not source or source in self._robots.components):
            self._people.set(_PICTURE + ref, "" if source == ref else source)
            self._show_picture(ref)

    def choose_stream(self, ref: str, url: str) -> str:
        """Offer the stream at ``url`` on the page of ``ref``; "" is the one that it reports.

        Returns why not; empty if it is done.
        """
        if ref not in self._robots.components:
            return "unknown component"
        if url and not origin(url):
            return "No stream: an address begins with http:// or https://, and has no login"
        if url and not origin(url, self.own_hosts):
            return "No stream: the page can be opened by this name or address, and browsers would send its login there"
        self._people.set(_STREAM + ref, url)
        self._robots.streams[ref] = url
        self._show_stream(ref)
        return ""

    def show(self, ref: str) -> None:
        """Send pages what was chosen for this component."""
        self._show_picture(ref)
        self._show_stream(ref)

    def _show_picture(self, ref: str) -> None:
        try:
            source = self._people.get(_PICTURE + ref) or ""
        except DatabaseError as error:
            log.warning("where the picture of %s comes from is not known: %s", ref, error)
            return
        self._robots.sources.pop(ref, None)
        if source:
            self._robots.sources[ref] = source
        self._on_change(ref)
        self._robots.set_server_metric(ref, "web/picture-from", m.PictureFrom(source=source))

    def _show_stream(self, ref: str) -> None:
        self._robots.set_server_metric(
            ref, "web/stream-address", m.StreamAddress(url=self._robots.streams.get(ref, ""))
        )
