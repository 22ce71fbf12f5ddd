"""Requests to the bridge itself: system actions, pictures and sound."""

from collections.abc import Callable
from functools import partial
from typing import Any

from pebble.contract import DRIVE, REMOTE_MIRROR, Channel, codec
from pebble.errors import PayloadError
from pebble.forwarding.forwarder import Mirroring
from pebble.runtime.parent import Notifier, earlier_requests
from pebble.runtime.service import Service
from pebble.services.mqtt_bridge.actions import ACTIONS, system_actions
from pebble.services.mqtt_bridge.media import MEDIA, Media


class OwnRequests:
    """Requests, read on the transports' threads; those that take longer are done on the thread of ``service``."""

    def __init__(
        self,
        service: Service,
        mirroring: Mirroring,
        notifier: Notifier,
        note_drive: Callable[[bytes], None],
    ) -> None:
        config, section = service.config, service.config.services.mqtt_bridge
        self._service, self._post, self._mirroring = service, service.post_message, mirroring
        self.actions = system_actions(section, config.state_dir(), service.clock)
        self._media = Media(config.on_demand_programs(), earlier_requests(), notifier.request)
        self._messages: dict[str, Callable[[bytes], None]] = {
            **{row.request.suffix: partial(self._on_media_request, row.request) for row in MEDIA},
            **{row.channel.suffix: partial(self._on_action, row.channel) for row in ACTIONS},
            DRIVE.suffix: note_drive,
        }
        self._flags: dict[str, Callable[[bytes], None]] = {
            **{row.flag.suffix: partial(self._on_media_flag, row.flag) for row in MEDIA},
            REMOTE_MIRROR.suffix: self._on_remote_mirror,
        }

    def message(self, channel: Channel, payload: bytes) -> None:
        """Take a message that is no flag."""
        reaction = self._messages.get(channel.suffix)
        if reaction is not None:
            reaction(payload)

    def flag(self, channel: Channel, payload: bytes) -> None:
        """Take the value of a flag."""
        reaction = self._flags.get(channel.suffix)
        if reaction is not None:
            reaction(payload)

    def send(self) -> None:
        """Tell the launcher which media programs are to run."""
        self._media.send()

    def _on_remote_mirror(self, payload: bytes) -> None:
        self._mirroring.switch(on=self._boolean(REMOTE_MIRROR, payload))

    def _on_media_flag(self, flag: Channel, payload: bytes) -> None:
        self._post(flag, partial(self._media.allow, flag, self._boolean(flag, payload)), newest_of=flag.metric)

    def _on_media_request(self, channel: Channel, payload: bytes) -> None:
        if (request := self._decoded(channel, payload)) is not None:
            self._post(channel, partial(self._media.request, channel, request), newest_of=channel.metric)

    def _on_action(self, channel: Channel, payload: bytes) -> None:
        if self._boolean(channel, payload):
            self._post(channel, partial(self._run_action, channel), newest_of=channel.metric)

    def _boolean(self, channel: Channel, payload: bytes) -> bool:
        """True if the payload is; an empty one (a removed flag) and a malformed one are false."""
        return bool(payload) and bool(self._decoded(channel, payload))

    def _decoded(self, channel: Channel, payload: bytes) -> Any:
        """Return the payload's value; None if it is malformed."""
        try:
            return codec.decode(channel, payload)
        except PayloadError as error:
            self._service.refusals.malformed(channel, error)
            return None

    def _run_action(self, channel: Channel) -> None:
        self._service.counters.add("actions" if self.actions[channel].request() else "actions_refused")
