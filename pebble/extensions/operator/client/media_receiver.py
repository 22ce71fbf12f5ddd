"""A receiver of one robot's pictures and sound, with their rate and age."""

import threading
import time

from pebble.contract import CAPABILITIES
from pebble.errors import PebbleError
from pebble.extensions.media.decode import Decoded, VideoDecoder
from pebble.extensions.media.picture_header import read_header
from pebble.extensions.media.rate_meter import RateMeter
from pebble.extensions.media.sound import ReceivedSound, SoundDecoder
from pebble.extensions.operator.client.media_request.offer import Medium
from pebble.extensions.operator.client.media_request.request import ViewerRequest, send
from pebble.extensions.operator.client.robot_view import RobotView
from pebble.transports import Message, QoS, Subscription, Transport

_STEP_S = 0.02  # until a request is sent


class MediaReceiver:
    """A receiver on ``transport``, which the caller opens and closes.

    The transport's threads decode; other threads may read ``newest``.
    """

    def __init__(self, transport: Transport, base: str) -> None:
        self.robot = RobotView(base)  # by its capabilities
        self.newest: Decoded | None = None
        self.pictures, self.sounds = RateMeter(), RateMeter()
        self.encoding: dict[Medium, str] = {}  # of the last payload
        self._video, self._audio = VideoDecoder(), SoundDecoder()
        self.requests: dict[Medium, ViewerRequest] = {}  # made by :meth:`request`
        self._transport = transport
        self._subscriptions: list[Subscription] = []
        self._is_known = threading.Event()  # capabilities have arrived
        self._subscriptions.append(transport.subscribe(CAPABILITIES.topic(base), self._on_capabilities))

    def wait_for_capabilities(self, timeout: float) -> None:
        """Wait for the robot's capabilities. Raises PebbleError on timeout."""
        if not self._is_known.wait(timeout):
            raise PebbleError(f"{self.robot.base} publishes no capabilities: is the robot up, and is this its broker?")

    def request(self, medium: Medium, encoding: str | None = None) -> None:
        """Request a medium in ``encoding``, or as configured. Raises PebbleError if the robot does not offer it."""
        request = self.requests.get(medium)
        if request is None:
            request = ViewerRequest(self.robot.base, medium, self.robot.capabilities)
            request.check(encoding)  # before anything is subscribed to
            self.requests[medium] = request
            self._subscribe(medium, request)
        request.want(encoding, time.monotonic())
        while not request.settled:
            send(self._transport, request.tick(time.monotonic()))
            time.sleep(_STEP_S)

    def poll(self) -> None:
        """Repeat requests while no payloads come, and request a missing key frame. Call it a few times a second."""
        now = time.monotonic()
        for request in list(self.requests.values()):
            if request.settled:  # else :meth:`request` still begins it
                send(self._transport, request.tick(now))
        if self._video.wants_keyframe and "video" in self.requests:
            send(self._transport, self.requests["video"].keyframe(self.encoding.get("video"), now))

    def close(self) -> None:
        """Withdraw the requests."""
        for request in list(self.requests.values()):
            send(self._transport, request.end())
        for subscription in self._subscriptions:
            subscription.close()

    def on_picture(self, picture: Decoded) -> None:
        """Handle a picture; override this method to get all pictures. Called on a thread of the transport."""

    def on_sound(self, received: ReceivedSound) -> None:
        """Handle a packet of sound; override this method to get all packets. Called on a thread of the transport."""

    # -- the transport's threads

    def _on_capabilities(self, message: Message) -> None:
        self.robot.receive(CAPABILITIES, message, 0.0, 0.0)
        if self.robot.estop.has_capabilities:
            self._is_known.set()

    def _subscribe(self, medium: Medium, request: ViewerRequest) -> None:
        take_payload = self._on_video if medium == "video" else self._on_audio

        def on_media(message: Message) -> None:
            request.receive(message, time.monotonic())
            take_payload(message.payload)

        def on_flag(message: Message) -> None:
            request.receive(message, time.monotonic())

        subscribe = self._transport.subscribe
        # The flag is handled at once, as only media take long. Our own requests for it are not to come back.
        self._subscriptions.append(subscribe(request.flag_topic, on_flag, echo=False, direct=True))
        self._subscriptions.append(subscribe(request.media_topic, on_media, qos=QoS.LATEST))

    def _on_video(self, payload: bytes) -> None:
        picture = self._video.feed(payload)
        age_s = None if picture is None or picture.captured_ms is None else time.time() - picture.captured_ms / 1000
        self.pictures.add(time.monotonic(), len(payload), age_s)
        if (header := read_header(payload)) is not None:
            self.encoding["video"] = header.encoding
        if picture is not None:
            self.newest = picture
            self.on_picture(picture)

    def _on_audio(self, payload: bytes) -> None:
        received = self._audio.feed(payload)
        if received is None:
            return
        self.sounds.add(time.monotonic(), len(payload), time.time() - received.captured_ms / 1000)
        self.encoding["audio"] = received.encoding
        self.on_sound(received)
