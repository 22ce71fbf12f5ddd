"""The queue of a robot's pictures for one page, and the choice between its two streams. Pure: times are passed in.

A page acknowledges each frame when it has drawn it, and few frames are under way at a time: otherwise a slow connection
would show what happened seconds ago. A difference is of no use without everything before it since the last key frame,
so if one is left out, all are until the next key frame. A page that cannot use the robot's own pictures gets the rescue
stream instead: small JPEGs that the server makes of them.
"""

from collections import deque
from collections.abc import Collection
from dataclasses import dataclass
from typing import Final

WINDOW: Final = 2  # frames sent and not acknowledged
#: With an acknowledgement later than the first the window is 1, until one is earlier than the second.
SLOW_ACK_S, FAST_ACK_S = 0.15, 0.12
#: More frames may be under way if they are small: they delay nothing, and a distant page would get too few of them.
SMALL_WINDOW, SMALL_BYTES = 8, 4096
#: A connection is thin, or far away, if two frames one after the other take longer: commands and echoes wait meanwhile.
THIN_ACK_S, THIN_FRAMES = 0.4, 2
MAX_FRAMES: Final = 4  # that wait for a viewer; the oldest goes
SLOW_FRAMES: Final = 1  # JPEG encodings on a slow connection: the next key frame is near, and shows what is newer
MAX_QUEUED_BYTES: Final = 4 << 20  # of these frames

_FRESH_FRAMES: Final = 2  # with no more than these in the queue, a key frame does not replace them
_JPEG_PATIENCE_S: Final = 1.0  # JPEG encodings have a key frame each third of a second, unless configured otherwise
_RESCUE_AFTER_S: Final = 1.5  # of waiting for a key frame of h264
_RETRY_S: Final = 60.0  # in the rescue stream, before the robot's own pictures are tried again


@dataclass(frozen=True, slots=True)
class Frame:
    """A message to pages; all pages share its bytes."""

    seq: int
    data: bytes
    encoding: str
    keyframe: bool  # needs no picture before it


class ViewerQueue:
    """The frames of either stream that wait for one page, and those sent and not yet acknowledged."""

    def __init__(self, can: frozenset[str], now: float) -> None:
        self.can = can  # the encodings that the page says it can decode
        self.rescued = False  # it gets the rescue stream
        self.unserved = True  # it has received no picture, and no key frame was requested for it
        self.waiting = True  # for a key frame
        self.overflowed = False  # waiting because the page is too slow
        self.window = WINDOW  # so many frames may be under way
        self.ack_s = 0.0  # how long the last frame took to be drawn and acknowledged
        self.late_acks = 0  # in a row; frames that were under way together count once
        self._late_at = float("-inf")  # when the newest was counted: frames sent before that do not count
        self._queue: deque[Frame] = deque()
        self._under_way: dict[int, tuple[float, Frame]] = {}  # by number: when it was sent, and the frame
        self._undecodable: set[str] = set()  # encodings that the page could not decode after all
        self._waiting_since = now  # for a key frame
        self._retry_at = 0.0  # when a rescued page gets the robot's own pictures again

    def offer(self, frame: Frame) -> None:
        """Queue a frame, or skip it."""
        if frame.keyframe:
            self._begin_at(frame)
        elif self.waiting:
            return
        elif self._has_room(frame):
            self._queue.append(frame)
        elif self._skips_early(frame):
            self.waiting = True  # what is in the queue is still sent
        else:
            self.overflowed = True
            self.wait_for_keyframe()

    def take(self, now: float) -> Frame | None:
        """Return the frame to send now; None if there is none, or too many are unacknowledged."""
        if not self._queue or not self._may_send(len(self._queue[0].data)):
            return None
        frame = self._queue.popleft()
        self._under_way[frame.seq] = (now, frame)
        return frame

    def acknowledge(self, seq: int, now: float) -> Frame | None:
        """Note that the page has handled this frame; return it if it was unacknowledged."""
        sent_at, frame = self._under_way.pop(seq, (0.0, None))
        if frame is not None:
            self.ack_s = now - sent_at
            self._note_lateness(sent_at, now)
            if self.ack_s > SLOW_ACK_S:
                self.window = 1
            elif self.ack_s < FAST_ACK_S:
                self.window = WINDOW
        return frame

    def _note_lateness(self, sent_at: float, now: float) -> None:
        if self.ack_s <= THIN_ACK_S:
            self.late_acks = 0
        elif sent_at >= self._late_at:
            self.late_acks += 1
            self._late_at = now

    def forget_lateness(self, now: float) -> None:
        """Forget that frames were late, because the page gets frames of the other stream from now on."""
        self.late_acks, self._late_at = 0, now

    def wait_for_keyframe(self) -> None:
        """Skip everything before the next key frame."""
        self._queue.clear()
        self.waiting = True

    def not_drawn(self) -> None:
        """Skip frames up to the next key frame, unless one waits or is on its way: the page could not draw a frame."""
        frames_under_way = [frame for _, frame in self._under_way.values()]
        if not any(frame.keyframe for frame in (*frames_under_way, *self._queue)):
            self.wait_for_keyframe()

    def _may_send(self, size: int) -> bool:
        under_way = len(self._under_way)
        if under_way < self.window:
            return True
        total = size + sum(len(frame.data) for _, frame in self._under_way.values())
        return under_way < SMALL_WINDOW and total <= SMALL_BYTES

    def _has_room(self, frame: Frame) -> bool:
        limit = SLOW_FRAMES if self._skips_early(frame) else MAX_FRAMES
        return len(self._queue) < limit and self._queued_bytes() + len(frame.data) <= MAX_QUEUED_BYTES

    def _skips_early(self, frame: Frame) -> bool:
        """True if frames are skipped though there is room: the page is slow, and the next key frame is near."""
        return self.window < WINDOW and frame.encoding != "h264"

    def _begin_at(self, frame: Frame) -> None:
        """Queue a key frame. Frames before it are dropped if the page is slow or waits for a key frame."""
        late = self.window < WINDOW or len(self._queue) > _FRESH_FRAMES
        if self.waiting or late or self._queued_bytes() + len(frame.data) > MAX_QUEUED_BYTES:
            self.wait_for_keyframe()
        self._queue.append(frame)
        self.waiting = self.overflowed = False

    def _queued_bytes(self) -> int:
        return sum(len(frame.data) for frame in self._queue)

    # -- the robot's own pictures, or the rescue stream

    def decodes(self, encoding: str) -> bool:
        return encoding in self.can and encoding not in self._undecodable

    def cannot_decode(self, encoding: str) -> None:
        """Note that the page cannot decode this encoding."""
        self._undecodable.add(encoding)

    def offer_direct(self, frame: Frame, now: float) -> None:
        """Queue or skip one of the robot's own pictures. A key frame ends the page's time in the rescue stream."""
        if self.rescued:
            if not (frame.keyframe and now >= self._retry_at and self.decodes(frame.encoding)):
                return
            self.rescued = False
            self.forget_lateness(now)
        was_waiting = self.waiting
        self.offer(frame)
        if not self.waiting:
            self.unserved = False
        elif not was_waiting:
            self._waiting_since = now

    def offer_rescue(self, frame: Frame) -> None:
        """Queue a picture of the rescue stream in place of a waiting one, if the page gets that stream."""
        if self.rescued:
            self.wait_for_keyframe()
            self.offer(frame)

    def lost(self, now: float) -> None:
        """Skip frames up to the next key frame, because a picture from the robot is missing."""
        if not self.rescued:
            self._note_waiting(now)
            self.wait_for_keyframe()

    def note_keyframe_request(self, now: float) -> None:
        """Skip frames up to the next key frame, because the page requested one."""
        if not self.rescued:
            self._note_waiting(now)
            self.not_drawn()

    @property
    def is_thin(self) -> bool:
        """True if the page's connection is too slow for large frames."""
        return self.late_acks >= THIN_FRAMES

    def rescue(self, now: float) -> None:
        """Move the page to the rescue stream: for a while if it is slow, otherwise until the next key frame."""
        if self.overflowed or self.is_thin:  # slow; else ``_retry_at`` stays in the past: any key frame ends the rescue
            self._retry_at = now + _RETRY_S
        self.rescued = True
        self.wait_for_keyframe()
        self.overflowed = False
        self.forget_lateness(now)

    def waiting_s(self, now: float) -> float:
        """Return how long the page has waited for a key frame of the robot's own pictures."""
        return now - self._waiting_since if self.waiting and not self.rescued else 0.0

    def _note_waiting(self, now: float) -> None:
        if not self.waiting:
            self._waiting_since = now


def assess(viewers: Collection[ViewerQueue], encoding: str, now: float, *, can_rescue: bool) -> bool:
    """Move viewers between the two streams; return True to request a key frame (at most once a second).

    A key frame costs all viewers and the robot's uplink. One is requested if most wait, or once for a new viewer. A
    slow viewer among fast ones gets the rescue stream instead, and so does one whose connection is thin.
    JPEG encodings have key frames often: there a single new or slow viewer only waits for the next one.
    """
    for viewer in viewers:
        if can_rescue and not viewer.rescued and (viewer.is_thin or not viewer.decodes(encoding)):
            viewer.rescue(now)
    direct = [viewer for viewer in viewers if not viewer.rescued and viewer.decodes(encoding)]
    patience_s = 0.0 if encoding == "h264" else _JPEG_PATIENCE_S
    waiting = [viewer for viewer in direct if viewer.waiting and viewer.waiting_s(now) >= patience_s]
    most_wait = bool(direct) and 2 * len(waiting) >= len(direct)
    if most_wait or encoding != "h264":  # JPEG: a few viewers wait for the next one
        return most_wait
    for viewer in waiting:
        if can_rescue and (viewer.overflowed or viewer.waiting_s(now) > _RESCUE_AFTER_S):
            viewer.rescue(now)
    return any(viewer.unserved for viewer in waiting)  # new ones, for which none was requested yet
