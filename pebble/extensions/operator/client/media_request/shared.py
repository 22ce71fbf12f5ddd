"""A robot's pictures or sound, requested while they are wanted here and a little longer."""

import asyncio
import contextlib
import logging
import time
from collections.abc import Awaitable, Callable
from typing import Any, Final

from pebble.errors import PebbleError
from pebble.extensions.operator.client.broker import Broker
from pebble.extensions.operator.client.media_request.offer import CHANNELS, WORDS, Medium, refusal
from pebble.extensions.operator.client.media_request.request import ViewerRequest, send
from pebble.extensions.operator.client.robot_topics import named_topic
from pebble.extensions.operator.client.robot_view import RobotView
from pebble.transports import Message, Subscription

log = logging.getLogger(__name__)

LINGER_S: Final = 5.0  # unwanted, before the request is withdrawn: a page that reloads is back by then
TICK_S: Final = 0.5
_STEP_S: Final = 0.02  # until a request is sent
_PROGRAMS: Final[dict[Medium, str]] = {"video": "camera_publisher", "audio": "audio_publisher"}
_WAITS: Final[dict[Medium, str]] = {"video": "Pictures wait for driving", "audio": "it waits for driving"}


class SharedRequest:
    """A request for a robot's pictures or sound, shared by all that show them here.

    Used on the event loop only. Await :meth:`follow` and :meth:`request_keyframe` only in the step of :meth:`run`.
    """

    def __init__(self, broker: Broker, ref: str, medium: Medium, receive: Callable[[bytes], None]) -> None:
        """Store the settings. ``receive`` gets each payload."""
        self.ref, self.medium = ref, medium
        self.problem = ""  # why it is not requested
        self.encoding: str | None = None  # as requested; None: as configured, or nothing is requested
        self.waits = ""  # why the robot holds the medium back for now; the request is not repeated meanwhile
        self.requested_at = float("-inf")  # in its present encoding
        self._broker, self._receive = broker, receive
        self._request: ViewerRequest | None = None
        self._topics: list[str | None] = []  # that the capabilities named at the request
        self._subscriptions: list[Subscription] = []
        self._wanted = self._closing = False
        self._wanted_at = float("-inf")  # when it was wanted last
        self._wakeup = asyncio.Event()

    def want(self, wanted: bool) -> None:
        """Set whether the medium is shown or played now."""
        if wanted or self._wanted:
            self._wanted_at = time.monotonic()
        self._wanted = wanted
        self.wake()

    def wake(self) -> None:
        """Let the next step come soon."""
        self._wakeup.set()

    def close(self) -> None:
        """End :meth:`run` soon."""
        self._closing = True
        self.wake()

    async def wait_until_wanted(self) -> None:
        while not self._wanted:
            self._wakeup.clear()
            await self._wakeup.wait()

    async def run(self, step: Callable[[], Awaitable[None]]) -> None:
        """Await ``step`` twice a second, and soon after a wake, until the medium was not wanted for a while.

        At the end, also if it is cancelled, the request is withdrawn.
        """
        try:
            while not self._closing:
                if not self._is_over():
                    began = time.monotonic()
                    await step()
                    await self._pause(began)
                    continue
                await self._withdraw()
                if self._is_over():  # else something has come to want it meanwhile
                    return
        finally:
            await self._withdraw()

    async def follow(self, robot: RobotView, encoding: str | None) -> None:
        """Request the medium if it is wanted and the robot permits it. Call this in each step."""
        capabilities = robot.capabilities
        self.waits = _WAITS[self.medium] if robot.holds(_PROGRAMS[self.medium]) else ""
        self.problem = refusal(self.ref, capabilities, self.medium)
        if self.problem:
            await self._withdraw()
            return
        if not self._wanted or self.waits:
            return
        try:
            await self._follow(capabilities, encoding)
        except PebbleError as error:
            self.problem = str(error)

    async def request_keyframe(self, encoding: str) -> None:
        """Request a key frame in the encoding that arrives, at most once a second."""
        if self._request is not None and not self.waits:
            send(self._broker.transport, self._request.keyframe(encoding, time.monotonic()))

    async def _follow(self, capabilities: dict[str, Any], encoding: str | None) -> None:
        """Request the medium in this encoding, or repeat the request; withdraw it if that fails."""
        topics = [named_topic(self.ref, capabilities, channel) for channel in CHANNELS[self.medium]]
        request = self._request
        try:
            if request is None or topics != self._topics:
                await self._withdraw()
                request = self._request = ViewerRequest(self.ref, self.medium, capabilities, shares=True)
                self._topics = topics
                for topic in (request.control_topic, request.flag_topic, request.media_topic):
                    self._subscriptions.append(await self._broker.subscribe(topic, self._take))
            request.section = capabilities[self.medium]
            is_first = self.requested_at == float("-inf")
            if is_first or encoding != self.encoding:
                self.encoding, self.requested_at = encoding, time.monotonic()
                request.want(encoding, self.requested_at)
            send(self._broker.transport, request.tick(time.monotonic()))
            while not request.settled:  # it first waits for payloads that come without a request
                await asyncio.sleep(_STEP_S)
                send(self._broker.transport, request.tick(time.monotonic()))
        except PebbleError:
            await self._withdraw()
            raise

    def _take(self, message: Message, at: float) -> None:
        if self._request is not None and self._request.receive(message, at):
            self._receive(message.payload)

    async def _withdraw(self) -> None:
        request, self._request = self._request, None
        subscriptions, self._subscriptions = self._subscriptions, []
        self.encoding, self.requested_at = None, float("-inf")
        try:
            send(self._broker.transport, [] if request is None else request.end())
        except PebbleError as error:
            log.warning("the %s of %s: %s", WORDS[self.medium].name, self.ref, error)
        for subscription in subscriptions:
            await self._broker.unsubscribe(subscription)

    def _is_over(self) -> bool:
        """True if the medium was not wanted for a while, and the robot can be told so; else it would go on sending."""
        idle = not self._wanted and time.monotonic() - self._wanted_at >= LINGER_S
        return idle and (self._broker.connected or self._request is None)

    async def _pause(self, began: float) -> None:
        """Pause until 0.5 s after the last step ``began``. A wake ends the pause, but not within 0.1 s of ``began``."""
        await asyncio.sleep(max(0.0, began + TICK_S / 5 - time.monotonic()))
        with contextlib.suppress(TimeoutError):  # wait_for of Python 3.11 loses a cancellation that meets a wakeup
            async with asyncio.timeout(max(0.001, began + TICK_S - time.monotonic())):
                await self._wakeup.wait()
        self._wakeup.clear()
