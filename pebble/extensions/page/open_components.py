"""The components that pages have open, and the subscriptions for only those."""

from __future__ import annotations

import asyncio
import logging
from collections import Counter
from collections.abc import Callable, Coroutine
from typing import Any, NamedTuple

from msgspec.structs import replace

from pebble import contract as c
from pebble.contract import OUTGOING, codec
from pebble.errors import PayloadError, PebbleError
from pebble.extensions.operator.client.broker import Broker
from pebble.extensions.operator.client.robot_topics import FLAGS, PLACES, WATCHED
from pebble.extensions.page.log_lines import LogLines
from pebble.extensions.page.messages import FlagsView
from pebble.extensions.page.robots import Robots
from pebble.transports import Message, Subscription

log = logging.getLogger(__name__)

KEEP_S = 5.0  # so long they are still received after the last page has closed the component
_FLAGS_METRIC = "web/flags"
STEP_S = 1.0  # between two changes of what is received of one component: capabilities may change without end


class _Meaning(NamedTuple):
    """The component and channel of a topic whose name does not show them: flags and renamed topics."""

    ref: str
    channel: c.Channel


#: Filters to subscribe to; None: the names of the topics show component and channel.
_Filters = dict[str, _Meaning | None]

#: Channels for which capabilities may name a topic that is subscribed to, besides overlays and flags.
_NAMED = [
    channel
    for channel in PLACES
    if channel.direction == OUTGOING and channel.payload is not bytes and channel is not c.VIDEO_OVERLAYS
]
#: Fields of FlagsView.
_FLAG_FIELDS = {flag: flag.metric.removeprefix("flags/").replace("-", "_") for flag in FLAGS.values()}


class OpenComponents:
    """The subscriptions for components that at least one page has open. Used on the event loop only."""

    def __init__(
        self,
        broker: Broker,
        robots: Robots,
        spawn: Callable[[Coroutine[Any, Any, None]], None],
    ) -> None:
        """Store the arguments. ``spawn`` runs a coroutine in the background."""
        self._broker, self._robots, self._spawn = broker, robots, spawn
        self._pages: Counter[str] = Counter()  # by component: how many have it open
        self._subscriptions: dict[str, dict[str, Subscription]] = {}  # by component and filter
        self._following: set[str] = set()  # components whose task, _follow, runs
        self._wanted: dict[str, _Filters] = {}  # by component: what its task, _follow, subscribes to
        self._flags: dict[str, FlagsView] = {}  # by component: its flags as pages see them

    @property
    def known(self) -> set[str]:
        """Return the components whose messages are received or remembered here."""
        return {*self._pages, *self._subscriptions, *self._wanted, *self._flags}

    def __contains__(self, ref: object) -> bool:
        return ref in self._pages

    def open(self, ref: str) -> None:
        self._pages[ref] += 1
        self._robots.logs.setdefault(ref, LogLines())
        self.update(ref)

    def close(self, ref: str) -> None:
        self._broker.loop.call_later(KEEP_S, self._closed, ref)

    def _closed(self, ref: str) -> None:
        """Note that a page was closed. It is called after a delay, so that a reloaded page still finds everything."""
        self._pages[ref] -= 1
        if not self._pages[ref]:
            del self._pages[ref]
            self.update(ref)

    def update(self, ref: str) -> None:
        """Update a component's subscriptions after its capabilities, or the pages that show it, may have changed."""
        wanted = set(self._filters(ref)) if ref in self._pages else None
        received = set(self._subscriptions[ref]) if ref in self._subscriptions else None
        if ref not in self._following and wanted != received:
            self._following.add(ref)
            self._spawn(self._follow(ref))

    async def _follow(self, ref: str) -> None:
        """Subscribe and unsubscribe until there are exactly the needed subscriptions."""
        failed: set[str] = set()  # filters that are tried again, but logged once
        try:
            subscriptions = self._subscriptions.setdefault(ref, {})
            while True:
                wanted = self._wanted[ref] = self._filters(ref) if ref in self._pages else {}
                for filter_ in subscriptions.keys() - wanted:
                    await self._broker.unsubscribe(subscriptions.pop(filter_))
                for filter_ in [filter_ for filter_ in wanted if filter_ not in subscriptions]:
                    try:
                        subscriptions[filter_] = await self._broker.subscribe(filter_, self._receiver(ref, filter_))
                    except PebbleError as error:
                        if filter_ not in failed:
                            failed.add(filter_)
                            log.warning("%s is not received: %s", filter_, error)
                if wanted and self._broker.connected:
                    self._show_flags(ref, self._flags.get(ref, FlagsView()))  # even if none arrived: none is set
                if not wanted:
                    if ref in self._pages:  # opened again meanwhile
                        continue
                    self._forget(ref)
                    return
                await asyncio.sleep(STEP_S)  # the least time between two changes
                if ref in self._pages and self._filters(ref).keys() == subscriptions.keys():
                    return  # nothing has changed meanwhile, and nothing failed
        finally:
            self._following.discard(ref)

    def _forget(self, ref: str) -> None:
        """Forget what was kept for a component's open page, and the component if it has published nothing."""
        self._subscriptions.pop(ref, None)
        self._wanted.pop(ref, None)
        self._flags.pop(ref, None)
        self._robots.logs.pop(ref, None)
        self._robots.remove_server_metric(ref, _FLAGS_METRIC)
        if ref not in self._robots.components:
            self._robots.forget(ref)

    def _receiver(self, ref: str, filter_: str) -> Callable[[Message, float], None]:
        """Return the callback for messages of a subscription of this component."""

        def take(message: Message, now: float) -> None:
            meaning = self._wanted.get(ref, {}).get(filter_)  # None: the topic's name shows component and channel
            if meaning is None:
                self._robots.receive(message, now)
            elif meaning.channel.kind is c.Kind.FLAG:
                self._receive_flag(ref, meaning.channel, message)
            else:
                self._robots.receive_as(meaning.ref, meaning.channel.metric, message, now, meaning.channel)

        return take

    def _receive_flag(self, ref: str, channel: c.Channel, message: Message) -> None:
        """Store a flag's newest value; an empty message removes it."""
        try:
            value = codec.decode(channel, message.payload) if message.payload else None
        except PayloadError:
            return
        view = replace(self._flags.get(ref, FlagsView()), **{_FLAG_FIELDS[channel]: value})
        self._show_flags(ref, view)

    def _show_flags(self, ref: str, view: FlagsView) -> None:
        self._flags[ref] = view
        self._robots.set_server_metric(ref, _FLAGS_METRIC, view)

    def _filters(self, ref: str) -> _Filters:
        """Return the topics of an open component: the contract's, those it names, and drawings over its picture.

        Of several meanings of one topic the first counts, but that of a flag in any case.
        """
        filters: _Filters = {channel.filter(ref): None for channel in WATCHED}  # None: the names tell the meaning
        for channel in _NAMED:
            self._add(filters, ref, channel)
        for flag in FLAGS.values():
            filters[self._robots.topic(ref, flag)] = _Meaning(ref, flag)
        source = self._robots.sources.get(ref, ref)
        filters.setdefault(c.VIDEO_OVERLAYS.filter(source), None)
        self._add(filters, source, c.VIDEO_OVERLAYS)
        return filters

    def _add(self, filters: _Filters, ref: str, channel: c.Channel) -> None:
        """Add the topic of a channel, if the component's capabilities name another than the contract's."""
        topic = self._robots.topic(ref, channel)
        if topic != channel.topic(ref):
            filters.setdefault(topic, _Meaning(ref, channel))
