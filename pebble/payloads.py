"""One frozen struct per payload of the contract, named in wire spelling. Facts: paper Appendix A.8 and its tables.

Unknown fields are tolerated, wrong types are not. Numbers are finite: NaN and infinity are no numbers here.
Values that the contract clamps are clamped when the struct is made, so nothing out of range exists further in.
"""

from __future__ import annotations

import math
from typing import Any, Literal

from msgspec import UNSET, Struct, UnsetType, field
from msgspec.structs import force_setattr


class Payload(Struct, frozen=True, kw_only=True, omit_defaults=False):
    """Base of every JSON payload: refuses NaN and infinities wherever a number may stand."""

    def __post_init__(self) -> None:
        for name in self.__struct_fields__:
            value = getattr(self, name)
            if isinstance(value, float) and not math.isfinite(value):
                raise ValueError(f"{name} is not a finite number")


def _clamp(payload: Payload, low: float, high: float, *names: str) -> None:
    for name in names:
        force_setattr(payload, name, min(max(getattr(payload, name), low), high))


# -- incoming


class Drive(Payload, frozen=True, kw_only=True):
    """Wanted motion. Missing axes are 0; everything is clamped to -1..1 (paper A.8.3)."""

    x: float = 0.0  # steering, positive turns right
    z: float = 0.0  # throttle, positive is forward
    y: float = 0.0  # auxiliary axis, for example MiniLAMP's grousers

    def __post_init__(self) -> None:
        super().__post_init__()
        _clamp(self, -1.0, 1.0, "x", "z", "y")


class LightsSolid(Payload, frozen=True, kw_only=True):
    """A steady colour, each channel 0..1 (paper A.8.4)."""

    b: float = 0.0
    g: float = 0.0
    r: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        _clamp(self, 0.0, 1.0, "b", "g", "r")


class LightsFlash(LightsSolid, frozen=True, kw_only=True):
    """A colour that fades in and out once every ``period`` seconds (≥ 0.05)."""

    period: float = 2.0

    def __post_init__(self) -> None:
        super().__post_init__()
        _clamp(self, 0.05, math.inf, "period")


class SoundboardCommand(Payload, frozen=True, kw_only=True):
    """Play or stop a clip (paper A.8.10); ``action`` wins over ``enabled``."""

    action: str | None = None
    enabled: bool | None = None
    file: str | None = None


class AutonomyCommand(Payload, frozen=True, kw_only=True):
    """Start or stop one script (paper A.8.11)."""

    action: str | None = None
    enabled: bool | None = None
    file: str | None = None
    config: dict[str, Any] | None = None


class MediaRequest(Payload, frozen=True, kw_only=True, omit_defaults=True):
    """Start or stop remote video or audio; ``encoding`` None, or one we do not have: as configured."""

    enabled: bool
    encoding: str | None = None
    keyframe: bool = False  # a full picture next, please


class OutletCommand(Payload, frozen=True, kw_only=True):
    """Switch an outlet; only a JSON boolean switches anything."""

    on: bool


# -- outgoing


class Heartbeat(Payload, frozen=True, kw_only=True):
    """Sign of life; as the will it says ``online: false`` (paper A.8.5)."""

    t: int  # epoch milliseconds
    online: bool | UnsetType = UNSET


class ChargingStatus(Payload, frozen=True, kw_only=True):
    """Is the robot on its charger? null: it cannot tell."""

    value: bool | None


class ChargingLevel(Payload, frozen=True, kw_only=True):
    """Battery voltage; some robots without a unit send per cent."""

    value: float
    unit: str | UnsetType = "v"


class TouchValues(Payload, frozen=True, kw_only=True):
    """Three raw readings of the MCU's converter (hall sensors on Goob)."""

    a0: int
    a1: int
    a2: int


class TouchSensors(Payload, frozen=True, kw_only=True):
    """Raw touch or hall readings."""

    value: TouchValues
    unit: str = "adc"


class Capabilities(Payload, frozen=True, kw_only=True):
    """What a robot can do and under which names (paper A.8.6)."""

    t: int  # epoch milliseconds
    value: dict[str, Any]
    schema: str = "pebble-capabilities/v1"


class LogRecord(Payload, frozen=True, kw_only=True):
    """One log line (paper A.8.7); ``message`` at most 2048 characters by default."""

    t: int  # epoch milliseconds
    level: str
    service: str
    message: str
    logger: str = "root"
    pid: int = 0


class ServiceState(Payload, frozen=True, kw_only=True):
    """How one service process fares, inside ``Status``."""

    state: Literal["init", "ready", "restarting", "failed", "stopped"]
    restarts: int = 0
    last_exit: str | None = None  # for example "exit code 1" or "signal 9"


class Status(Payload, frozen=True, kw_only=True):
    """A robot's general state; ours carries ``services``, other components put anything into ``value``."""

    t: int | UnsetType = UNSET  # epoch milliseconds
    value: dict[str, Any] = field(default_factory=dict)


class MediaReport(Payload, frozen=True, kw_only=True, omit_defaults=True):
    """How one stream (``camera``, ``microphone``) or one media program fares; what does not apply is absent."""

    running: bool
    doing: str | None = None  # for people: "h264 640x480, 10 fps, 212 kbit/s"
    encoding: str | None = None
    width: int | None = None  # of what is sent, or captured
    height: int | None = None
    rate: float | None = None  # frames, or packets of sound, per second, over the last seconds
    bitrate: int | None = None  # bits per second of what left, over the last seconds
    readers: int | None = None
    fallbacks: int | None = None  # frames that could not travel through shared memory
    dropped: int | None = None  # frames or packets thrown away because somebody was too slow
    restarts: int | None = None  # how often the device was opened again
    reduced: str | None = None  # what is done about a slow link: "quality 6", "size 1/2", "rate 1/2"
    last_error: str | None = None


class MediaStatus(Payload, frozen=True, kw_only=True):
    """Everything about pictures and sound: by stream and by program."""

    t: int  # epoch milliseconds
    value: dict[str, MediaReport]


class Vector(Payload, frozen=True, kw_only=True):
    x: float
    y: float
    z: float


class Orientation(Payload, frozen=True, kw_only=True):
    """Degrees."""

    roll: float
    pitch: float


class ImuFastValues(Payload, frozen=True, kw_only=True):
    accel_mps2: Vector
    gyro_dps: Vector
    temp_c: float
    orientation_deg: Orientation


class ImuFast(Payload, frozen=True, kw_only=True):
    """Every sample of the inertial sensor; stays on the robot."""

    t: int
    seq: int
    mcu_ms: int
    value: ImuFastValues


class ImuHealth(Payload, frozen=True, kw_only=True):
    device: str
    protocol: str
    instance: str
    samples_ok: int
    samples_error: int
    calibration_samples: int


class ImuValues(ImuFastValues, frozen=True, kw_only=True):
    accel_norm_g: float
    gyro_bias_dps: Vector
    health: ImuHealth


class Imu(Payload, frozen=True, kw_only=True):
    """The inertial sensor's summary for operators."""

    t: int
    seq: int
    mcu_ms: int
    value: ImuValues


class McuManifest(Payload, frozen=True, kw_only=True):
    """What a self-describing MCU says of itself."""

    protocol: str
    schema_version: int
    interface_count: int
    schema_hash: str
    device_uid: str
    firmware_version: str
    model: str
    interfaces: list[dict[str, Any]]


class McuSample(Payload, frozen=True, kw_only=True):
    """One reading of a self-describing MCU's interface."""

    t: int
    seq: int
    mcu_ms: int
    device_uid: str
    interface: str
    profile: str
    value: dict[str, Any]


class SoundboardFiles(Payload, frozen=True, kw_only=True):
    files: list[str]
    timestamp: float  # epoch seconds
    controls: bool = True


class SoundboardStatus(Payload, frozen=True, kw_only=True):
    playing: bool
    timestamp: float  # epoch seconds
    file: str | None = None
    error: str | None = None
    controls: bool = True


class AutonomyFiles(Payload, frozen=True, kw_only=True):
    files: list[dict[str, Any]]
    timestamp: float  # epoch seconds
    controls: bool = True


class AutonomyDependency(Payload, frozen=True, kw_only=True):
    file: str
    pid: int | None
    running: bool


class AutonomyStatus(Payload, frozen=True, kw_only=True):
    running: bool
    timestamp: float  # epoch seconds
    file: str | None = None
    pid: int | None = None
    dependencies: list[AutonomyDependency] = field(default_factory=list)
    error: str | None = None
    config: dict[str, Any] | None = None
    controls: bool = True


class WheelOdometry(Payload, frozen=True, kw_only=True):
    """Dead reckoning from the wheels; the fields of ``value`` vary by producer (paper A.8.12)."""

    value: dict[str, Any]
    timestamp: float  # epoch seconds
    unit: str = "mm"
    source: str | UnsetType = UNSET


Corners = list[tuple[float, float]]  # normalised 0..1


class TagDetection(Payload, frozen=True, kw_only=True):
    marker_id: int
    corners_norm: Corners
    center_norm: tuple[float, float]


class TagLocations(Payload, frozen=True, kw_only=True):
    """All AprilTags in one camera picture."""

    source: str
    detections: list[TagDetection]
    frame_width: int
    frame_height: int
    timestamp: float  # epoch seconds


class TagData(Payload, frozen=True, kw_only=True):
    """The tag being followed; ``angle_rad`` is positive to the right."""

    detected: bool
    timestamp: float  # epoch seconds
    marker_id: int | None = None
    corners_norm: Corners | None = None
    distance_m: float | None = None
    angle_rad: float | None = None


class OverlayLabel(Payload, frozen=True, kw_only=True):
    marker_id: int
    center_norm: tuple[float, float]


class VideoOverlays(Payload, frozen=True, kw_only=True):
    """Polylines and labels to draw over the picture."""

    source: str
    shapes: list[Corners]
    frame_width: int
    frame_height: int
    timestamp: float  # epoch seconds
    labels: list[OverlayLabel] = field(default_factory=list)


class OutletStatus(Payload, frozen=True, kw_only=True):
    """An outlet as its station reports it: ``value`` holds ``bound``, ``reachable`` and ``on``."""

    value: dict[str, Any]
    label: str | UnsetType = UNSET


class AnyObject(Payload, frozen=True, kw_only=True):
    """A payload whose fields other components define (ROS extras); only the stamp is common."""

    t: int | UnsetType = UNSET
    timestamp: float | UnsetType = UNSET
