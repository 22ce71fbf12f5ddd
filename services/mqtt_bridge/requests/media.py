"""Requests for media programs: a flag set by operators permits them, a request starts and stops them."""

import os
from collections.abc import Callable, Collection, Mapping
from typing import Any, ClassVar, Final, NamedTuple

from msgspec import Struct

from pebble.contract import AUDIO_CONTROL, MQTT_AUDIO, MQTT_VIDEO, VIDEO_CONTROL, Channel, Kind
from pebble.contract.encodings import ALL_SOUND, ALL_VIDEO
from pebble.contract.payloads import MediaRequest
from pebble.runtime.parent import WANTED, Notifier
from pebble.runtime.service import Service
from pebble.services.mqtt_bridge.own_requests import Requests


class ProgramRequest(NamedTuple):
    """A request to run an on-demand program, which begins with ``encoding`` (empty: as configured), or to end it."""

    on: bool
    encoding: str = ""


class Row(Struct, frozen=True, eq=False):
    """A medium: the flag that permits it, the channel that requests it, its encodings and its programs."""

    flag: Channel
    request: Channel
    encodings: tuple[str, ...]
    programs: tuple[str, ...]


MEDIA: Final = (
    Row(MQTT_VIDEO, VIDEO_CONTROL, ALL_VIDEO, ("camera_publisher", "video_stream")),
    Row(MQTT_AUDIO, AUDIO_CONTROL, ALL_SOUND, ("audio_publisher", "audio_receiver")),
)
_ROWS: Final = {channel.suffix: row for row in MEDIA for channel in (row.flag, row.request)}
_NO: Final = ProgramRequest(on=False)


class Media:
    """The newest flag and request of each medium of a robot that has ``programs``. Changes go to the launcher.

    ``running`` are the programs that an earlier bridge process had requested. They count as requested, because a
    request is never retained and the operator does not know that the bridge was restarted. Until the flag of a medium
    is known, its programs are left as they are, except that a request may stop them. ``send_one`` returns False if the
    launcher is busy; this never waits for it.
    """

    def __init__(
        self,
        programs: Collection[str],
        running: Mapping[str, ProgramRequest] | None = None,
        send_one: Callable[[str, ProgramRequest], bool] = lambda _program, _request: True,
    ) -> None:
        self._programs, self._send_one = programs, send_one
        self._allowed: dict[Row, bool] = {}  # the flag of each medium, once it is known
        self._requested = {row: _earlier_request(row, running or {}) for row in MEDIA}
        self._sent: dict[str, ProgramRequest] = {}  # by program

    def allow(self, flag: Channel, allowed: bool) -> None:
        self._allowed[_ROWS[flag.suffix]] = allowed
        self.send()

    def request(self, channel: Channel, request: MediaRequest) -> None:
        """Note the newest request. An unknown encoding stands for the configured one."""
        row = _ROWS[channel.suffix]
        encoding = request.encoding if request.encoding in row.encodings else None
        self._requested[row] = ProgramRequest(request.enabled, encoding or "")
        self.send()

    def requests(self) -> dict[str, ProgramRequest]:
        """Return the requests by program, without those whose flag is still unknown."""
        requests: dict[str, ProgramRequest] = {}
        for row, request in self._requested.items():
            if request.on and row not in self._allowed:
                continue
            runs = request.on and self._allowed[row]
            requests |= dict.fromkeys(row.programs, request if runs else _NO)
        return {name: request for name, request in requests.items() if name in self._programs}

    def send(self) -> None:
        """Send the requests that have changed, and again those that the launcher has not accepted."""
        for program, request in self.requests().items():
            if self._sent.get(program) != request and self._send_one(program, request):
                self._sent[program] = request


def earlier_requests() -> dict[str, ProgramRequest]:
    """Return the requests of an earlier process of this program, by the requested program."""
    words = (word.partition("=") for word in os.environ.get(WANTED, "").split())
    return {name: ProgramRequest(on=True, encoding=encoding) for name, _, encoding in words}


def _earlier_request(row: Row, running: Mapping[str, ProgramRequest]) -> ProgramRequest:
    return next((running[name] for name in row.programs if name in running), _NO)


class MediaRequests(Requests):
    """The requests for a robot's media programs, sent on to its launcher."""

    channels: ClassVar[tuple[Channel, ...]] = tuple(channel for row in MEDIA for channel in (row.flag, row.request))

    def __init__(self, service: Service) -> None:
        super().__init__(service)
        notifier = Notifier()
        self._media = Media(
            service.config.on_demand_programs(),
            earlier_requests(),
            lambda program, request: notifier.request(program, request.on, request.encoding),
        )

    def take(self, channel: Channel, value: Any) -> None:
        if channel.kind is Kind.FLAG:
            self._media.allow(channel, value)
        else:
            self._media.request(channel, value)

    def repeat(self) -> None:
        self._media.send()
