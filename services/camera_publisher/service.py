"""The service that sends the camera's pictures: at the configured rate, never old ones, on its own connection."""

from functools import partial
from typing import Any

from pebble.contract import CAMERA, MEDIA_REPORT, VIDEO_CONTROL
from pebble.contract.payloads import MediaReport, MediaRequest
from pebble.errors import DeviceError, PebbleError
from pebble.extensions.media.config import Media
from pebble.extensions.media.frames import FrameReader
from pebble.extensions.media.frames.frame import Frame
from pebble.extensions.media.rate_meter import RateMeter
from pebble.extensions.media.video import VIDEO_ENCODINGS, VideoEncoder, make_encoder
from pebble.runtime.connections import remote_transport
from pebble.runtime.parent import requested_encoding
from pebble.runtime.service import Service, every, on
from pebble.runtime.source_check import SourceCheck
from pebble.services.camera_publisher.camera_reader import CameraReader
from pebble.services.camera_publisher.frame_selector import KeyframeRequests
from pebble.services.camera_publisher.rate_control import RateController, wire_size
from pebble.services.camera_publisher.shape import Pixels, Shape
from pebble.transports import QoS, State
from pebble.transports.counters import in_words

_FPS = 15.0  # where the config names none; the camera's own default
_POLL_S = 0.02  # between two measurements while a picture is in flight
_QUIET_S = 2.0  # without a frame before that is reported
_BLACK, _DARK = "black", 24  # of 255: noise, and what some cameras call black
_STEP = 8  # pixels, between those that are looked at
_WORST_QUALITY = 3  # of a JPEG: below it nothing gets smaller


class CameraPublisher(Service):
    """The sender of pictures. While the remote broker is away it encodes nothing, and soon reads nothing either."""

    name = "camera_publisher"
    client_name = "local-camera-publisher"

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._options = video = self.config.section(Media).video_publisher
        now = self.clock()
        self._fps = video.publish_fps or video.target_fps or video.fps or _FPS
        width, height = video.publish_width or video.width, video.publish_height or video.height
        self._shape = Shape(width, height, video.rotate_degrees)
        self._sent_size: tuple[int, int] | None = None  # width and height of the last picture
        self._camera_at = now  # when its last frame came
        self._polling = False  # the next call of _poll is planned
        self._problem = ""  # why a picture was not sent, or not as requested
        self._blackness = SourceCheck()  # for how long all pictures are black, see _black
        self._meter, self._keyframes = RateMeter(), KeyframeRequests()
        self._picture_topic = self.addresses[CAMERA].topic
        self._remote = remote_transport(self.config, "camera-publisher")
        thin = self.config.services.mqtt_bridge.link.profile != "wide"
        self._rate = RateController(self._fps, now, lambda: self._remote.outgoing, self.counters, thin=thin)
        self._encoding = self._known(requested_encoding())
        self._encoder = self._make_encoder(self._encoding)
        self._reader = CameraReader(
            lambda: FrameReader(self.config.run_dir(), "camera", views=True),
            partial(self.post, self._on_frame, newest_of="frame"),
            partial(self.post, self._on_end),
        )

    def start(self) -> None:
        self.on_stop(lambda: self.log.info("pictures: %s", in_words(self.counters.snapshot())))
        self._remote.on_state(lambda _state: self.post(self._on_remote))
        self._remote.open(timeout=0.0)
        self.on_stop(self._remote.close)
        self._reader.open()
        self.on_stop(self._reader.close)

    @on(VIDEO_CONTROL)
    def control(self, request: MediaRequest) -> None:
        if not request.enabled:
            return  # the launcher is about to stop this process
        encoding = self._known(request.encoding)
        if encoding != self._encoding:
            self._encoding = encoding
            self._encoder = self._make_encoder(encoding)
        if request.keyframe:
            self._keyframes.request()

    def _known(self, requested: str | None) -> str:
        """Return the requested encoding if this installation has it, else the configured one."""
        return requested if requested is not None and requested in VIDEO_ENCODINGS else self._options.encoding

    def _make_encoder(self, name: str) -> VideoEncoder:
        """Return the encoder called ``name``.

        If it cannot be made, return the one that every robot has and every client reads.
        """
        try:
            encoder = self._open_encoder(name)
        except PebbleError as error:
            self._problem = str(error)
            self.log.warning("pictures are sent as json: %s", error)
            encoder = self._open_encoder("json")
        self._keyframes.require()
        self.log.info("pictures are sent as %s, %g per second", encoder.name, self._fps)
        return encoder

    def _open_encoder(self, name: str) -> VideoEncoder:
        options = self._options
        # Unless the config is for H.264, its interval is meant for JPEGs, and would make H.264 three times as large.
        uses_interval = name != "h264" or options.encoding == "h264"
        return make_encoder(
            name,
            fps=self._fps,
            keyframe_interval=options.keyframe_interval if uses_interval else None,
            quality=options.jpeg_quality,
        )

    def _on_remote(self) -> None:
        """Adapt to the connection's present state. Frames in flight are lost, even if it is connected again."""
        self._rate.connection_lost()
        self._keyframes.require()
        self._meter.clear()
        self._blackness.clear()
        self._camera_at = self.clock()
        self._reader.enabled = self._remote.state is State.CONNECTED
        self._report()

    def _poll(self) -> None:
        """Measure the picture in flight. It is called repeatedly, as only this shows how long a picture took."""
        step = self._rate.poll(self.clock())
        if step is not None:
            self.log.info("reduced because the connection is slow: %s", str(step) or "nothing any more")
        self._polling = self._rate.in_flight
        if self._polling:
            self.call_at(self.clock() + _POLL_S, self._poll)

    def _on_end(self) -> None:
        raise DeviceError("the thread that reads the camera's frames has ended")  # the launcher restarts this process

    def _on_frame(self) -> None:
        frame = self._reader.take()
        if frame is None:
            return
        self._camera_at = now = self.clock()
        captured_s = frame.info.captured_ns / 1e9 if frame.info.captured_ns else now  # a writer may leave it out
        try:
            if self._rate.may_encode(captured_s, now):
                self._send_frame(frame)
        except PebbleError as error:
            self._throw_away("failed")
            self._problem = str(error)
            self.log_limited.warning("a frame", "a frame of the camera cannot be sent: %s", error)
        finally:
            frame.release()

    def _send_frame(self, frame: Frame) -> None:
        """Encode a frame and send it, unless it was overwritten meanwhile or the connection takes no more."""
        picture = self._shape.picture(frame, self._rate.step.size)
        payload = self._encode(picture, frame.info.captured_ms)
        now = self.clock()
        # SourceCheck measures how long a value stays the same. Black pictures have one; others the time, always new.
        self._blackness.take(_BLACK if is_black(picture) else now, now)
        if not frame.valid():
            self._throw_away("overwritten")  # by the next frame, while it was encoded
        elif not self._remote.publish(self._picture_topic, payload, qos=QoS.LATEST):
            self._throw_away("refused")
        else:
            self._sent(picture, payload, now)

    def _encode(self, picture: Pixels, captured_ms: int) -> bytes:
        quality = self._options.jpeg_quality
        self._encoder.quality = max(min(quality, _WORST_QUALITY), round(quality * self._rate.step.quality))
        return self._encoder.encode(picture, captured_ms, keyframe=self._keyframes.due(self.clock()))

    def _throw_away(self, why: str) -> None:
        """Drop an encoded picture. The next one must not build upon it, as the encoder assumes that it was sent."""
        self.counters.add(why)
        self._keyframes.require()

    def _sent(self, picture: Pixels, payload: bytes, now: float) -> None:
        """Count a picture that was sent, and watch it on its way: `_poll` then continues until none is in flight."""
        self._rate.sent(wire_size(self._picture_topic, payload), now)
        self.counters.add("sent")
        self._meter.add(now, len(payload))
        self._sent_size = (picture.shape[1], picture.shape[0])
        if self._encoder.last_was_keyframe:
            self._keyframes.sent(now)
        if not self._polling:
            self._polling = True
            self.call_at(now + _POLL_S, self._poll)

    @every(1.0)
    def _report(self) -> None:
        now = self.clock()
        rate, bitrate = self._meter.rate(now), self._meter.bitrate(now)
        width, height = self._sent_size or (None, None)
        report = MediaReport(
            running=self._reader.enabled,
            doing=self._doing(rate, bitrate),
            encoding=self._encoder.name,
            width=width,
            height=height,
            rate=round(rate, 2),
            bitrate=round(bitrate),
            dropped=sum(self.counters[why] for why in ("held_back", "overwritten", "refused", "failed")),
            reduced=str(self._rate.step) or None,
            problem=self._black if self._reader.enabled else None,
            last_error=self._trouble() or None,
        )
        self.publish(MEDIA_REPORT, report, program=self.name)

    def _doing(self, rate: float, bitrate: float) -> str:
        if not self._reader.enabled:
            return "rests: the remote side is away"
        if self._sent_size is None:
            return "waits for the camera"
        width, height = self._sent_size
        return f"{self._encoder.name} {width}x{height}, {rate:.1f} fps, {bitrate / 1000:.0f} kbit/s"

    def _trouble(self) -> str:
        if not self._reader.enabled:
            return self._remote.problem
        quiet_s = self.clock() - self._camera_at
        if not self._reader.problem and quiet_s > _QUIET_S:
            return f"no frame from the camera for {quiet_s:.0f} s"
        return self._reader.problem or self._black or self._problem

    @property
    def _black(self) -> str | None:
        return f"shows only black since {self._blackness.same_s:.0f} s" if self._blackness.repeats else None


def is_black(picture: Pixels) -> bool:
    """True if the picture is all black, as with a lid on the lens."""
    return bool(picture[::_STEP, ::_STEP].max() <= _DARK)
