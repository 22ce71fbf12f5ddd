"""Requests every robot's pictures and sound in one encoding after another, and counts what arrives."""

import threading
from collections import Counter
from collections.abc import Iterable
from contextlib import suppress
from itertools import count

from pebble.contract.encodings import ALL_SOUND, ALL_VIDEO
from pebble.errors import PebbleError
from pebble.extensions.media.decode import Decoded
from pebble.extensions.media.sound import ReceivedSound
from pebble.extensions.operator.client.media_receiver import MediaReceiver
from pebble.extensions.operator.client.media_request.offer import Medium
from pebble.transports import MqttSettings, Transport, create

TURN_S = 4.0  # for each encoding
_STEP_S = 0.1
_CAPABILITIES_TIMEOUT_S = 5.0
_NAME = "pebble-demo-viewer"
_ENCODINGS: dict[Medium, tuple[str, ...]] = {"video": ALL_VIDEO, "audio": ALL_SOUND}


class CountedMedia(MediaReceiver):
    """The pictures and sounds of a robot, ``counted`` by encoding. The transport's threads write, another reads."""

    def __init__(self, transport: Transport, base: str) -> None:
        super().__init__(transport, base)
        self.counted: Counter[str] = Counter()

    def missing(self) -> list[str]:
        """Return the encodings in which nothing arrived."""
        return [name for name in (*ALL_VIDEO, *ALL_SOUND) if not self.counted[name]]

    def on_picture(self, picture: Decoded) -> None:
        self.counted[picture.encoding] += 1

    def on_sound(self, received: ReceivedSound) -> None:
        self.counted[received.encoding] += 1


class MediaViewer:
    """The demo's viewer, with a thread and a connection of its own; ``received``: by the robots' names."""

    def __init__(self, port: int) -> None:
        self.received: dict[str, CountedMedia] = {}
        self._transport = create("mqtt", _NAME, MqttSettings(host="127.0.0.1", port=port))
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name=_NAME, daemon=True)

    def begin(self, bases: Iterable[str]) -> None:
        """Start requesting media of the robots with these base topics, round after round."""
        self._transport.open(timeout=0.0)
        self.received = {view.robot.name: view for view in [CountedMedia(self._transport, base) for base in bases]}
        self._thread.start()

    def end(self) -> None:
        """Withdraw the requests and disconnect."""
        self._stopping.set()
        if self._thread.is_alive():
            self._thread.join(2.0)
        self._transport.close()

    # -- the viewer's thread

    def _run(self) -> None:
        for media in self.received.values():
            with suppress(PebbleError):  # then nothing arrives
                media.wait_for_capabilities(_CAPABILITIES_TIMEOUT_S)
        for turn in count():
            for media in self.received.values():
                for medium, encodings in _ENCODINGS.items():
                    with suppress(PebbleError):  # then nothing arrives
                        media.request(medium, encodings[turn % len(encodings)])
            if self._wait():
                break
        for media in self.received.values():
            media.close()

    def _wait(self) -> bool:
        """Wait for the time of one turn; True if the demo ends."""
        for _ in range(round(TURN_S / _STEP_S)):
            for media in self.received.values():
                media.poll()
            if self._stopping.wait(_STEP_S):
                return True
        return False
