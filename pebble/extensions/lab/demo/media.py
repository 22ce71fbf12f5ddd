"""Requests every robot's pictures and sound in one encoding after another, and counts what arrives.

A robot has one encoding for everybody: while a person watches or listens to it, it is left as that person chose.
"""

import threading
from collections import Counter
from collections.abc import Iterable
from contextlib import suppress
from functools import partial
from itertools import count

from pebble.contract import AUDIO_CONTROL, VIDEO_CONTROL, Channel, codec
from pebble.contract.encodings import ALL_SOUND, ALL_VIDEO
from pebble.errors import PayloadError, PebbleError
from pebble.extensions.media.decode import Decoded
from pebble.extensions.media.sound import ReceivedSound
from pebble.extensions.operator.client.media_receiver import MediaReceiver
from pebble.extensions.operator.client.media_request.offer import Medium
from pebble.extensions.operator.client.robot_topics import topic_of
from pebble.transports import Message, MqttSettings, Transport, create

TURN_S = 4.0  # for each encoding
ROUND = max(len(ALL_VIDEO), len(ALL_SOUND))  # turns until every encoding had one
_STEP_S = 0.1
_CAPABILITIES_TIMEOUT_S = 5.0
_NAME = "pebble-demo-viewer"
_CONTROLS: dict[Medium, Channel] = {"video": VIDEO_CONTROL, "audio": AUDIO_CONTROL}


class CountedMedia(MediaReceiver):
    """One robot's pictures and sounds, ``counted`` by encoding. The transport's threads write, another one reads."""

    def __init__(self, transport: Transport, base: str) -> None:
        super().__init__(transport, base)
        self._transport = transport
        self.counted: Counter[str] = Counter()
        self.watched: set[Medium] = set()  # that others have requested
        self.was_watched = False

    def watch_requests(self) -> None:
        """Notice the requests of others from now on; to be called once the capabilities are known."""
        for medium, channel in _CONTROLS.items():
            topic = topic_of(self.robot.base, self.robot.capabilities, channel)
            self._transport.subscribe(topic, partial(self._requested, medium, channel))

    def ask(self, medium: Medium, encoding: str) -> None:
        """Request an encoding, unless a person has requested one; raises PebbleError if the robot does not offer it."""
        if medium not in self.watched:
            self.request(medium, encoding)

    def missing(self) -> list[str]:
        """Return the encodings of which nothing arrived; none if people have chosen theirs meanwhile."""
        return [] if self.was_watched else [name for name in (*ALL_VIDEO, *ALL_SOUND) if not self.counted[name]]

    def on_picture(self, picture: Decoded) -> None:
        self.counted[picture.encoding] += 1

    def on_sound(self, received: ReceivedSound) -> None:
        self.counted[received.encoding] += 1

    def _requested(self, medium: Medium, channel: Channel, message: Message) -> None:
        own = self.requests.get(medium)
        if own is not None and message.payload in own.sent:
            own.sent.remove(message.payload)
            return
        try:
            request = codec.decode(channel, message.payload)
        except PayloadError:
            return
        self.was_watched = True
        if request.enabled:
            self.watched.add(medium)
            if own is not None:
                own.leave()
        else:
            self.watched.discard(medium)


class MediaViewer:
    """The demo's viewer, on a thread and a connection of its own; ``received``: by the robots' names."""

    def __init__(self, port: int) -> None:
        self.received: dict[str, CountedMedia] = {}
        self._transport = create("mqtt", _NAME, MqttSettings(host="127.0.0.1", port=port))
        self._stopping = threading.Event()
        self._thread = threading.Thread()

    def begin(self, bases: Iterable[str], *, once: bool = False) -> None:
        """Start requesting media of the robots with these base topics, round after round or ``once``."""
        self._transport.open(timeout=0.0)
        self.received = {view.robot.name: view for view in [CountedMedia(self._transport, base) for base in bases]}
        turns = range(ROUND) if once else count()
        self._thread = threading.Thread(target=self._run, args=(turns,), name=_NAME, daemon=True)
        self._thread.start()

    def end(self) -> None:
        """Withdraw the requests and disconnect."""
        self._stopping.set()
        if self._thread.is_alive():
            self._thread.join(2.0)
        self._transport.close()

    # -- the viewer's thread

    def _run(self, turns: Iterable[int]) -> None:
        for media in self.received.values():
            with suppress(PebbleError):  # then nothing arrives
                media.wait_for_capabilities(_CAPABILITIES_TIMEOUT_S)
            media.watch_requests()
        for turn in turns:
            self._take_turn(ALL_VIDEO[turn % len(ALL_VIDEO)], ALL_SOUND[turn % len(ALL_SOUND)])
            if self._stopping.is_set():
                break
        for media in self.received.values():
            media.close()

    def _take_turn(self, video: str, audio: str) -> None:
        for media in self.received.values():
            with suppress(PebbleError):  # then nothing arrives
                media.ask("video", video)
            with suppress(PebbleError):
                media.ask("audio", audio)
        for _ in range(round(TURN_S / _STEP_S)):
            for media in self.received.values():
                if not media.watched:
                    media.poll()
            if self._stopping.wait(_STEP_S):
                return
