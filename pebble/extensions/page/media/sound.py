"""Robots' sound for pages, and people's voices for robots, by one request for each robot."""

import asyncio
import struct
import time
from collections import deque
from collections.abc import Callable
from typing import Final

import msgspec
from starlette.websockets import WebSocket, WebSocketDisconnect

from pebble.contract import AUDIO, AUDIO_STREAM
from pebble.errors import PayloadError
from pebble.extensions.fleet.roles import Session, page_rights
from pebble.extensions.media.packets import Codec, Sound
from pebble.extensions.operator.client.broker import Broker
from pebble.extensions.operator.client.media_request.offer import BEST_FIRST, best, offered, refusal
from pebble.extensions.page.media.stream import MediaStream, Streams
from pebble.extensions.page.media.talk import PIECE_BYTES, SILENT_S, Talk, Voice
from pebble.extensions.page.messages import SoundView, TalkAnswer
from pebble.extensions.page.pace import Pace
from pebble.extensions.page.robots import Robots
from pebble.transports import QoS

MAX_PAYLOAD: Final = 256 << 10  # bytes of one packet
WINDOW: Final = 32  # packets sent and not acknowledged: what waits in a slow connection cannot be taken back
MAX_PACKETS, MAX_BYTES = 10, 256 << 10  # that wait to be sent
_NAMES: Final = {Codec.OPUS: "opus", Codec.PCM16LE: "pcm"}
_MAX_ANSWERS: Final = 8  # that wait for one page
_HEAD: Final = struct.Struct(">BI")
_PIECE: Final = struct.Struct(">BII")
_RECEIVED, _VOICE, _END = range(3)  # what a page sends
_AT_REST: Final = SoundView(state="rest", why="", encoding="", listeners=0, talker="")

NoteTalk = Callable[[str, Session, str, str], None]  # component, session, device and address, for the audit log


class SoundQueue:
    """The packets that wait for one page; if there are too many, the oldest goes. Pure."""

    def __init__(self) -> None:
        self._queue: deque[bytes] = deque()
        self._bytes = self._sent = self._received = 0  # bytes that wait; packets sent, and received by the page

    def offer(self, payload: bytes) -> None:
        self._queue.append(payload)
        self._bytes += len(payload)
        while len(self._queue) > MAX_PACKETS or self._bytes > MAX_BYTES:
            self._bytes -= len(self._queue.popleft())

    def take(self) -> bytes | None:
        """Return the packet to send now; None if there is none, or too many are unacknowledged."""
        if not self._queue or self._sent - self._received >= WINDOW:
            return None
        payload = self._queue.popleft()
        self._bytes -= len(payload)
        self._sent += 1
        return payload

    def acknowledge(self, count: int) -> None:
        """Note that the page has received ``count`` packets since it connected."""
        self._received = max(self._received, min(count, self._sent))


class SoundPage:
    """A page for a robot's sound, both ways. ``can``: the encodings that it plays; if none, it only talks."""

    def __init__(self, can: frozenset[str], session: Session, device: str = "", address: str = "") -> None:
        self.can, self.session, self.device, self.address = can, session, device, address
        self.queue = SoundQueue()
        self.answers: deque[TalkAnswer] = deque(maxlen=_MAX_ANSWERS)
        self.wakeup = asyncio.Event()
        self.last_ended = -1  # its newest talk that has ended, or was refused

    def answer(self, talk: int, *, on: bool, why: str = "") -> None:
        if not on:
            self.last_ended = max(self.last_ended, talk)
        self.answers.append(TalkAnswer(talk=talk, on=on, why=why))
        self.wakeup.set()


class SoundStream(MediaStream[SoundPage, SoundView]):
    """The sound of one robot for its listeners, and the voice of one talker for the robot."""

    def __init__(self, broker: Broker, robots: Robots, ref: str, note: NoteTalk) -> None:
        super().__init__(broker, robots, ref, "audio", "web/sound", _AT_REST)
        self._voice = Voice()  # makes packets of a talk
        self._note_talk = note  # for the audit
        self._talk: Talk | None = None  # the present one
        self._talker: SoundPage | None = None  # whose talk it is

    def leave(self, viewer: SoundPage) -> None:
        super().leave(viewer)
        self._end_talk(viewer)

    def receive(self, payload: bytes) -> None:
        """Queue a piece of the robot's sound for each page that can decode it: ``can`` has the encodings."""
        encoding = _encoding(payload)
        if not encoding:
            return
        self._note(encoding, len(payload), time.monotonic())
        for viewer in self.viewers:
            if encoding in viewer.can:
                viewer.queue.offer(payload)
                viewer.wakeup.set()

    # -- talking

    def receive_voice(self, page: SoundPage, talk: int, piece: int, sound: bytes) -> None:
        """Handle 20 ms of a page's voice. The first piece begins a talk, if that is allowed."""
        now = time.monotonic()
        self._end_silent_talk(now)  # perhaps the talk of this very piece
        if talk <= page.last_ended:  # a late piece of a talk that has ended must not begin it again
            return
        is_of_this_talk = self._talk is not None and page is self._talker and talk == self._talk.number
        if not is_of_this_talk:
            if why := self._why_not(page):
                page.answer(talk, on=False, why=why)
                return
            self._begin(page, talk, now)
        if self._talk is not None and self._talk.takes(piece, now):
            topic = self._robots.topic(self.ref, AUDIO_STREAM)
            packet = self._voice.packet(sound, time.time())
            if not self._broker.publish(topic, packet, qos=QoS(AUDIO_STREAM.default_qos)):
                self._interrupt("The server cannot reach the broker")

    def end_talk(self, page: SoundPage, talk: int) -> None:
        page.last_ended = max(page.last_ended, talk)
        if self._talk is not None and talk == self._talk.number:
            self._end_talk(page)

    def _begin(self, page: SoundPage, talk: int, now: float) -> None:
        self._talk, self._talker = Talk(talk, now), page
        page.last_ended = talk - 1
        self._voice.begin(time.time())
        page.answer(talk, on=True)
        self._note_talk(self.ref, page.session, page.device, page.address)
        self._request.wake()

    def _why_not(self, page: SoundPage) -> str:
        """Return why the page may not talk now; empty if it may."""
        if "drive" not in page_rights(page.session.role):
            return f"The role {page.session.role} may not do this"
        if self._talker is not None and self._talker is not page:
            return f"{self._talker.session.user} is talking"
        return self._unheard() or refusal(self.ref, self.robot.capabilities, "audio")

    def _unheard(self) -> str:
        """Return why the robot would not play a voice now; empty if it would."""
        if problem := self._broker.problem:
            return f"The server cannot reach the broker: {problem}"
        robot = self.robot
        if robot.online(time.monotonic()) is False:
            return f"{robot.name} is silent"
        if robot.slow_s is not None:  # commands would wait behind a voice
            return f"The connection of {robot.name} is too slow for a voice"
        return ""

    def _end_silent_talk(self, now: float) -> None:
        """End a talk whose page has stopped sending."""
        if self._talk is not None and self._talk.is_over(now):
            self._interrupt(f"No sound came in time for {SILENT_S:g} s")

    def _interrupt(self, why: str) -> None:
        """End a talk, and tell its page why."""
        if self._talk is not None and self._talker is not None:
            self._talker.answer(self._talk.number, on=False, why=why)
            self._end_talk(self._talker)

    def _end_talk(self, page: SoundPage) -> None:
        if page is self._talker and self._talk is not None:
            page.last_ended = max(page.last_ended, self._talk.number)
            self._talk = self._talker = None
            self._request.wake()

    # -- requests, and what pages are shown

    async def _follow(self) -> None:
        self._end_silent_talk(time.monotonic())
        robot = self.robot
        if why := refusal(self.ref, robot.capabilities, "audio") or self._unheard():
            self._interrupt(why)
        encoding = best("audio", offered(robot.capabilities, "audio"), self._listeners_encodings())
        await self._request.follow(robot, encoding)

    def _listeners_encodings(self) -> list[frozenset[str]]:
        """Return the encodings that each listener plays. Pages that only talk are no listeners."""
        return [viewer.can for viewer in self.viewers if viewer.can]

    def _make_view(self, state: str, why: str, _rate: float, _kbits: float) -> SoundView:
        """Return the state of the sound for pages, which show rates of pictures only."""
        return SoundView(
            state=state,
            why=why,
            encoding=self._arrivals.encoding,
            listeners=len(self._listeners_encodings()),
            talker="" if self._talker is None else self._talker.session.user,
        )

    def _problem(self) -> str:
        encodings, arriving = self._listeners_encodings(), self._arrivals.encoding
        lacking = sum(arriving not in playable for playable in encodings)
        return f"{lacking} of {len(encodings)} browsers cannot play {arriving}" if lacking else ""


class SoundHub(Streams[SoundStream]):
    """All sound streams. Used on the event loop only."""

    def __init__(self, broker: Broker, robots: Robots, note: NoteTalk) -> None:
        super().__init__(AUDIO, lambda ref: SoundStream(broker, robots, ref, note))

    async def serve(
        self, websocket: WebSocket, ref: str, can: frozenset[str], session: Session, device: str = "", address: str = ""
    ) -> None:
        """Serve a page that plays the encodings ``can`` and may talk, until either end closes the socket."""
        page = SoundPage(can & frozenset(BEST_FIRST["audio"]), session, device, address)
        await self.let_view(
            websocket, ref, page, lambda _: _send(websocket, page), lambda stream: _receive(websocket, stream, page)
        )


def _encoding(payload: bytes) -> str:
    if len(payload) > MAX_PAYLOAD:
        return ""
    try:
        return _NAMES.get(Codec(Sound.unpack(payload).codec), "")
    except (PayloadError, ValueError):
        return ""


async def _send(websocket: WebSocket, page: SoundPage) -> None:
    """Send answers and packets in turn, and wait while there is neither, until the socket is closed."""
    try:
        while True:
            payload = page.queue.take()
            if page.answers:
                await websocket.send_text(msgspec.json.encode(page.answers.popleft()).decode())
            if payload is not None:
                await websocket.send_bytes(payload)
            elif not page.answers:
                await page.wakeup.wait()
                page.wakeup.clear()
    except (WebSocketDisconnect, RuntimeError, OSError):  # RuntimeError: it is closed
        return


async def _receive(websocket: WebSocket, stream: SoundStream, page: SoundPage) -> None:
    """Handle a page's messages until it closes the socket, or sends an invalid one."""
    pace = Pace(time.monotonic())
    while True:
        message = await websocket.receive()
        data = message.get("bytes")
        if message["type"] != "websocket.receive" or not data:
            return
        if wait_s := pace.take(1, time.monotonic()):
            await asyncio.sleep(wait_s)
        what, size = data[0], len(data)
        if what == _VOICE and size == _PIECE.size + PIECE_BYTES:
            _, talk, piece = _PIECE.unpack_from(data)
            stream.receive_voice(page, talk, piece, data[_PIECE.size :])
        elif what == _RECEIVED and size == _HEAD.size:
            page.queue.acknowledge(_HEAD.unpack(data)[1])
            page.wakeup.set()
        elif what == _END and size == _HEAD.size:
            stream.end_talk(page, _HEAD.unpack(data)[1])
        else:
            return
