"""Sends the camera's pictures to operators: paced by the clock, as young as the link allows, by a link of its own."""

from __future__ import annotations

import time
from functools import partial

from pebble.contract import CAMERA, MEDIA_REPORT, VIDEO_CONTROL
from pebble.errors import LinkError, PebbleError
from pebble.launched import encoding_asked_for
from pebble.links import remote_transport
from pebble.media.video import VIDEO_ENCODINGS, VideoEncoder, make_encoder
from pebble.payloads import MediaReport, MediaRequest
from pebble.service import Service, every, on
from pebble.services.camera_publisher.feed import Feed
from pebble.services.camera_publisher.keyframes import Keyframes
from pebble.services.camera_publisher.pacing import Pacer
from pebble.services.camera_publisher.shape import Pixels, Shape
from pebble.services.camera_publisher.tally import Tally
from pebble.services.camera_publisher.uplink import Uplink
from pebble.transports import State
from pebble.transports.frame import Frame
from pebble.transports.frames import FrameReader

_FPS = 15.0  # where the config names none; the camera's own default
_LOOK_S = 0.02  # how soon after a picture went out, and how often then, one looks whether it has arrived
_QUIET_S = 2.0  # without a frame before that is reported
_WORST_QUALITY = 3  # of a JPEG: below it nothing gets smaller


class CameraPublisher(Service):
    """Rests while nobody can receive anything: then nothing is encoded, and soon nothing is read."""

    name = "camera_publisher"
    publishes = (MEDIA_REPORT, CAMERA)
    client_name = "local-camera-publisher"

    def start(self) -> None:
        self._options = options = self.config.services.mqtt_bridge.media.video_publisher
        now = time.monotonic()
        self._fps = options.publish_fps or options.target_fps or options.fps or _FPS
        width, height = options.publish_width or options.width, options.publish_height or options.height
        self._shape = Shape(width, height, options.rotate_degrees)
        self._pacer, self._keyframes, self._tally = Pacer(self._fps), Keyframes(), Tally()
        self._sent_size: tuple[int, int] | None = None  # width and height of the last picture
        self._camera_at = now  # when its last frame came
        self._looking = self._held_back = False
        self._problem = ""  # the last one
        self._remote = remote_transport(self.config, "camera-publisher")
        self._uplink = Uplink(self._remote, self.addresses[CAMERA].topic, self._fps, now)
        self._encode_as(self._known(encoding_asked_for()))
        self._feed = Feed(
            self._make_reader, partial(self.post, self._on_frame, newest_of="frame"), partial(self.post, self._on_end)
        )
        self._feed.open()
        self._remote.on_state(lambda _state: self.post(self._on_remote))
        self._remote.open(timeout=0.0)

    def stop(self) -> None:
        if hasattr(self, "_feed"):
            self._feed.close()
            self._remote.close()
            self.log.info("pictures: %s", self.counters.snapshot())

    # -- what operators ask for

    @on(VIDEO_CONTROL)
    def control(self, request: MediaRequest) -> None:
        if not request.enabled:
            return  # whoever started us is about to stop us
        wanted = self._known(request.encoding)
        if wanted != self._encoding:
            self._encode_as(wanted)
        if request.keyframe:
            self._keyframes.ask()

    def _known(self, asked: str | None) -> str:
        """What is asked for, if we can make it; else what is configured."""
        return asked if asked is not None and asked in VIDEO_ENCODINGS else self._options.encoding

    def _encode_as(self, name: str) -> None:
        """From now on. What cannot be made here is replaced by the form that everybody can make and read."""
        self._encoding = name
        try:
            self._encoder = self._make_encoder(name)
        except PebbleError as error:
            self._problem = str(error)
            self.log.warning("pictures are sent as json: %s", error)
            self._encoder = self._make_encoder("json")
        self._keyframes.need()
        self._tune()
        self.log.info("pictures are sent as %s, %g per second", self._encoder.name, self._fps)

    def _make_encoder(self, name: str) -> VideoEncoder:
        options = self._options
        # An interval meant for JPEGs would make H.264 three times as large.
        meant = name != "h264" or options.encoding == "h264"
        return make_encoder(
            name,
            fps=self._fps,
            keyframe_interval=options.keyframe_interval if meant else None,
            quality=options.jpeg_quality,
            bitrate=options.bitrate,
        )

    # -- the link

    def _on_remote(self) -> None:
        """The state now: a change that was undone meanwhile is none, except that what was under way is lost."""
        now = time.monotonic()
        self._uplink.forget()
        self._keyframes.need()
        self._tally.start(now)
        self._camera_at = now
        self._feed.wanted = self._remote.state is State.CONNECTED
        self._report()

    def _look(self) -> None:
        """What has become of the pictures under way, and what follows from it."""
        if self._uplink.look(time.monotonic()):
            step = self._uplink.step
            self._pacer.fps = self._fps * float(step.rate)
            self._tune()
            self.log.info("the link gets %s", f"less: {step}" if str(step) else "everything again")

    def _look_again(self) -> None:
        """Soon after a picture was sent, until it has arrived: only so is known how long it took."""
        self._look()
        self._looking = self._uplink.busy
        if self._looking:
            self.call_at(time.monotonic() + _LOOK_S, self._look_again)

    def _tune(self) -> None:
        step, wanted = self._uplink.step, self._options.jpeg_quality
        self._encoder.quality = max(min(wanted, _WORST_QUALITY), round(wanted * step.quality))
        if self._options.bitrate is not None:
            self._encoder.bitrate = round(self._options.bitrate * step.bytes)

    # -- frames

    def _make_reader(self) -> FrameReader:
        return FrameReader(self.config.run_dir(), "camera", views=True)

    def _on_end(self) -> None:
        raise LinkError("the thread that reads the camera's frames has ended")  # the launcher starts us again

    def _on_frame(self) -> None:
        frame = self._feed.take()
        if frame is None:
            return
        self._camera_at = time.monotonic()
        captured_s = (frame.info.captured_ns or time.monotonic_ns()) / 1e9  # a writer need not say
        try:
            if self._pacer.due(captured_s) and self._may_send():
                self._take_turn(captured_s)
                self._send_frame(frame)
        except PebbleError as error:
            self._fail(error)
        finally:
            frame.release()

    def _may_send(self) -> bool:
        """Not while those before it are stuck: then a younger one will have its turn."""
        self._look()
        now = time.monotonic()
        if not self._uplink.full(now):
            return True
        self._held_back = self._held_back or self._uplink.late(now)
        self.counters.add("held_back")
        return False

    def _take_turn(self, captured_s: float) -> None:
        missed = self._pacer.use(captured_s)
        if self._held_back:  # else the camera was late
            self._uplink.lose(missed, time.monotonic())
        self._held_back = False

    def _send_frame(self, frame: Frame) -> None:
        picture = self._shape.picture(frame, self._uplink.step.size)
        keyframe = self._keyframes.wanted(time.monotonic())
        payload = self._encoder.encode(picture, frame.info.captured_ms, keyframe=keyframe)
        now = time.monotonic()
        if not frame.valid():
            self._throw_away("overwritten")  # while we looked at it
        elif not self._uplink.send(payload, now):
            self._throw_away("refused")
        else:
            self._sent(picture, len(payload), now)

    def _throw_away(self, why: str) -> None:
        """The encoder believes it was sent: the next one must not build upon it."""
        self.counters.add(why)
        self._keyframes.need()

    def _sent(self, picture: Pixels, size: int, now: float) -> None:
        self.counters.add("sent")
        self._tally.add(size, now)
        self._sent_size = (picture.shape[1], picture.shape[0])
        if self._encoder.last_was_keyframe:
            self._keyframes.sent(now)
        if not self._looking:
            self._looking = True
            self.call_at(now + _LOOK_S, self._look_again)

    def _fail(self, error: PebbleError) -> None:
        self._throw_away("failed")
        self._problem = str(error)
        self._quiet_log.warning("a frame", "a frame of the camera cannot be sent: %s", error)

    # -- how it goes

    @every(1.0)
    def _report(self) -> None:
        rate, bytes_per_s = self._tally.rates(time.monotonic())
        width, height = self._sent_size or (None, None)
        report = MediaReport(
            running=self._feed.wanted,
            doing=self._doing(rate, 8 * bytes_per_s),
            encoding=self._encoder.name,
            width=width,
            height=height,
            rate=round(rate, 2),
            bitrate=round(8 * bytes_per_s),
            dropped=sum(self.counters[why] for why in ("held_back", "overwritten", "refused", "failed")),
            reduced=str(self._uplink.step) or None,
            last_error=self._trouble() or None,
        )
        self.publish(MEDIA_REPORT, report, program=self.name)

    def _doing(self, rate: float, bits_per_s: float) -> str:
        if not self._feed.wanted:
            return "rests: the remote side is away"
        if self._sent_size is None:
            return "waits for the camera"
        width, height = self._sent_size
        return f"{self._encoder.name} {width}x{height}, {rate:.1f} fps, {bits_per_s / 1000:.0f} kbit/s"

    def _trouble(self) -> str:
        if not self._feed.wanted:
            return self._remote.problem
        quiet_s = time.monotonic() - self._camera_at
        if not self._feed.problem and quiet_s > _QUIET_S:
            return f"no frame from the camera for {quiet_s:.0f} s"
        return self._feed.problem or self._problem
