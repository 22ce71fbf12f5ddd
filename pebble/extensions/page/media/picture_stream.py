"""A robot's pictures on their way to the pages that show them."""

import asyncio
import struct
import time
from typing import Final, NamedTuple

from pebble.extensions.media.picture_header import PictureHeader, PictureSequence
from pebble.extensions.operator.client.broker import Broker
from pebble.extensions.operator.client.media_request.offer import BEST_FIRST, best, offered
from pebble.extensions.operator.client.media_request.queue import Frame, ViewerQueue, assess
from pebble.extensions.page.media import rescue
from pebble.extensions.page.media.rescue import RescuedPicture, RescueStream
from pebble.extensions.page.media.stream import MediaStream
from pebble.extensions.page.messages import PictureView
from pebble.extensions.page.robots import Robots

_CHANGE_S: Final = 1.0  # a new encoding begins with a key frame within this time: viewers need no help meanwhile
_MAX_CHAIN: Final = 240  # pictures since a key frame
_MAX_CHAIN_BYTES: Final = 8 << 20  # of these pictures
_HEAD: Final = struct.Struct(">IB")
_RESCUE_HEAD: Final = struct.Struct(">IBQ")
_KEY_FRAME_WANTED, _CANNOT_DECODE = 1, 2  # a page's answer to a frame; 0: it was drawn
_AT_REST: Final = PictureView(state="rest", why="", encoding="", per_second=0, kbits=0, viewers=0)


class KeyFrame(NamedTuple):
    """A picture that needs no picture before it."""

    payload: bytes
    received_at: float  # monotonic


class PageViewer:
    """A page's queue, and the event that wakes its sender."""

    def __init__(self, can: frozenset[str]) -> None:
        self.queue = ViewerQueue(can, time.monotonic())
        self.wakeup = asyncio.Event()


class PictureStream(MediaStream[PageViewer, PictureView]):
    """The pictures of one robot for the queues of its viewers."""

    def __init__(self, broker: Broker, robots: Robots, ref: str) -> None:
        super().__init__(broker, robots, ref, "video", "web/picture", _AT_REST)
        self._rescue = RescueStream(self._on_rescued)  # JPEGs for pages that cannot use the robot's own pictures
        self._sequence = PictureSequence()  # of the robot's pictures: notices missing ones
        #: The newest key frame and all pictures since; empty: one is missing, or it would be too long.
        self._chain: list[bytes] = []
        self._chain_bytes = 0
        self.key: KeyFrame | None = None  # the newest one
        self._seq = 0  # the number of the newest frame, of either stream

    # -- pages

    def acknowledge(self, viewer: PageViewer, seq: int, answer: int) -> None:
        """Handle a page's answer to the frame ``seq``."""
        now = time.monotonic()
        frame = viewer.queue.acknowledge(seq, now)
        if frame is not None:  # else an answer to a frame that was answered before, or never sent
            if answer == _KEY_FRAME_WANTED:
                viewer.queue.note_keyframe_request(now)
            elif answer == _CANNOT_DECODE:
                viewer.queue.cannot_decode(frame.encoding)
        viewer.wakeup.set()
        if answer:  # it was not drawn: a key frame, or another encoding, may have to be requested
            self._request.wake()

    # -- pictures

    def receive(self, payload: bytes) -> None:
        now = time.monotonic()
        header = self._sequence.take(payload)
        if header is None:
            return
        fits = self._sequence.complete  # no picture before this one is missing
        self._note(header.encoding, len(payload), now)
        self._extend_chain(payload, header, fits=fits)
        self._rescue.feed(payload, keyframe=header.keyframe)
        if fits:
            self._offer(payload, header, now)
        else:
            self._skip(now)

    def _extend_chain(self, payload: bytes, header: PictureHeader, *, fits: bool) -> None:
        """Extend, begin or end the chain: a key frame and all pictures since. ``fits``: none is missing before this."""
        grown = self._chain_bytes + len(payload)
        if header.keyframe:
            self.key = KeyFrame(payload, time.monotonic())
            self._chain, self._chain_bytes = [payload], len(payload)
        elif fits and self._chain and len(self._chain) < _MAX_CHAIN and grown <= _MAX_CHAIN_BYTES:
            self._chain.append(payload)
            self._chain_bytes = grown
        else:
            self._chain, self._chain_bytes = [], 0

    def _offer(self, payload: bytes, header: PictureHeader, now: float) -> None:
        """Queue a picture for each page that can show it; have a key frame requested soon for those that wait."""
        seq = self._next_seq()
        frame = Frame(seq, _HEAD.pack(seq, 0) + payload, header.encoding, header.keyframe)
        some_wait = False
        for viewer in self.viewers:
            queue = viewer.queue
            if queue.rescued or queue.decodes(header.encoding):  # rescued: a key frame may end that
                queue.offer_direct(frame, now)
                viewer.wakeup.set()
            some_wait = some_wait or (queue.waiting and not queue.rescued)
        if some_wait and header.encoding == "h264":  # of other encodings pages wait patiently: see assess()
            self._request.wake()

    def _skip(self, now: float) -> None:
        """Note that a picture is missing before this one: a key frame is needed."""
        for viewer in self.viewers:
            viewer.queue.lost(now)
        self._request.wake()

    def _on_rescued(self, picture: RescuedPicture) -> None:
        seq = self._next_seq()
        data = _RESCUE_HEAD.pack(seq, 1, picture.captured_ms) + picture.jpeg
        frame = Frame(seq, data, "jpeg", keyframe=True)
        for viewer in self.viewers:
            viewer.queue.offer_rescue(frame)
            viewer.wakeup.set()

    def _next_seq(self) -> int:
        self._seq = (self._seq + 1) % (1 << 32)
        return self._seq

    # -- requests, and key frames

    async def _follow(self) -> None:
        robot = self.robot
        encoding = best("video", offered(robot.capabilities, "video"), self._usable_encodings())
        await self._request.follow(robot, encoding)
        if not self._request.problem:
            await self._help_viewers()

    def _usable_encodings(self) -> list[frozenset[str]]:
        """Return for each viewer the encodings that it decodes or, if it decodes none, that this server converts."""
        encodings = frozenset(BEST_FIRST["video"])
        converted = frozenset(name for name in encodings if not rescue.unavailable(name))
        return [viewer.queue.can & encodings or converted for viewer in self.viewers]

    async def _help_viewers(self) -> None:
        """Request a key frame, or start the rescue stream, if viewers need it."""
        now = time.monotonic()
        if not self._arrivals.encoding:
            return
        changing = now - self._request.requested_at < _CHANGE_S  # to another encoding, which begins with a key frame
        can_rescue = not changing and not rescue.unavailable(self._arrivals.encoding)
        queues = [viewer.queue for viewer in self.viewers]
        wanted = assess(queues, self._arrivals.encoding, now, can_rescue=can_rescue)
        if can_rescue and any(queue.rescued for queue in queues):
            self._rescue.start(self._chain)
            wanted = wanted or not self._chain  # without pictures to convert, it begins with the next key frame
        else:
            self._rescue.stop()
        if wanted and not changing:
            for queue in queues:
                queue.unserved = False  # this key frame is for it
            await self._request.request_keyframe(self._arrivals.encoding)

    # -- what pages are shown

    def _make_view(self, state: str, why: str, rate: float, kbits: float) -> PictureView:
        return PictureView(
            state=state,
            why=why,
            encoding=self._arrivals.encoding,
            per_second=rate,
            kbits=kbits,
            viewers=len(self.viewers),
        )

    def _end(self) -> None:
        self._rescue.stop()

    def _problem(self) -> str:
        lacking = sum(not viewer.queue.decodes(self._arrivals.encoding) for viewer in self.viewers)
        problem = rescue.unavailable(self._arrivals.encoding)
        return f"{lacking} of {len(self.viewers)} browsers cannot show it: {problem}" if problem and lacking else ""
