"""Requests to the bridge itself: the flag remote-mirror, and requests that extensions carry out."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import partial
from typing import Any, ClassVar

from pebble.contract import DRIVE, REMOTE_MIRROR, Channel, Kind, codec
from pebble.errors import PayloadError
from pebble.extension import part
from pebble.forwarding.forwarder import Mirroring
from pebble.forwarding.observer import logged
from pebble.runtime.service import Service


class Requests(ABC):
    """Requests that an extension carries out. Made for the bridge's service, and called on its thread."""

    channels: ClassVar[tuple[Channel, ...]]

    def __init__(self, service: Service) -> None:
        self.service = service

    @abstractmethod
    def take(self, channel: Channel, value: Any) -> None:
        """Handle the value of a message. A flag that was removed, or cannot be read, is False."""

    def repeat(self) -> None:  # noqa: B027 - most do nothing
        """Try again the requests that failed; called once a second."""


class OwnRequests:
    """Requests to the bridge, read on the transports' threads, and carried out on the thread of ``service``.

    ``note_drive`` gets each drive command from operators.
    """

    def __init__(self, service: Service, mirroring: Mirroring, note_drive: Callable[[bytes], None]) -> None:
        self._service, self._mirroring, self._note_drive = service, mirroring, note_drive
        self._requests: list[Requests] = []
        for extension in service.config.installed:
            for place in extension.requests:
                with logged(extension.name):
                    self._requests.append(part(place)(service))
        # Who carries out the requests on a channel, by the channel's suffix.
        self._takers = {channel.suffix: requests for requests in self._requests for channel in requests.channels}

    def message(self, channel: Channel, payload: bytes) -> None:
        """Handle a message, but no flag: flags come to :meth:`flag`, once both sides agree on the value."""
        if channel is DRIVE:
            self._note_drive(payload)
        elif channel.kind is not Kind.FLAG and channel.suffix in self._takers:
            value = self._decode(channel, payload)
            if value is not None:
                self._take(channel, value)

    def flag(self, channel: Channel, payload: bytes) -> None:
        """Handle the value of a flag on which both sides agree."""
        if channel is REMOTE_MIRROR:
            self._mirroring.switch(on=bool(payload and self._decode(channel, payload)))
        elif channel.suffix in self._takers:
            self._take(channel, bool(payload and self._decode(channel, payload)))

    def repeat(self) -> None:
        """Try again all requests that have failed."""
        for requests in self._requests:
            requests.repeat()

    def _take(self, channel: Channel, value: Any) -> None:
        taker = self._takers[channel.suffix]
        self._service.post_message(channel, partial(taker.take, channel, value), newest_of=channel.metric)

    def _decode(self, channel: Channel, payload: bytes) -> Any:
        """Return the value of a message; None if it is malformed, which is counted."""
        try:
            return codec.decode(channel, payload)
        except PayloadError as error:
            self._service.refusals.malformed(channel, error)
            return None
