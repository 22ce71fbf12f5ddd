"""The payloads of the contract, a frozen struct each, with the field names of the wire. Source: paper Appendix A.8.

Unknown fields are tolerated, wrong types are not. Numbers are finite: NaN and infinity are refused.
Values that the contract clamps are clamped when the struct is made, so no value is out of range.
"""

import math
import sys
from typing import Annotated, Any, Literal

from msgspec import UNSET, Meta, Struct, UnsetType, field
from msgspec.structs import force_setattr

from pebble.motion import arbiter
from pebble.motion.lease import shown


class Payload(Struct, frozen=True, kw_only=True, omit_defaults=False):
    """The base class of JSON payloads. It refuses NaN, infinities, and integers that no float can hold."""

    def __post_init__(self) -> None:
        for name in self.__struct_fields__:
            value = getattr(self, name)
            if isinstance(value, int | float) and not abs(value) <= sys.float_info.max:  # also NaN
                raise ValueError(f"{name} is not a finite number")

    def ends(self) -> bool:
        """True if the message can only end something: a zero, or the end of a script, a sound or a picture."""
        return False


def _clamp(payload: Payload, low: float, high: float, *names: str) -> None:
    for name in names:
        force_setattr(payload, name, min(max(getattr(payload, name), low), high))


# -- incoming


SCRIPT = "autonomy"  # the source of a script's drive command; any other source is a person
LAST_RUN = arbiter.LAST_RUN
LinkLevel = Literal["wide", "narrow", "thin"]
LARGEST_MS = (1 << 53) - 1  # of a clock: the largest number that every JSON reader knows exactly


class Drive(Payload, frozen=True, kw_only=True):
    """Wanted motion. Axes that are missing or no number are 0; all are clamped to -1..1 (paper A.8.3).

    A script signs its commands with ``source`` and ``run``; ``valid_ms`` limits how long this command moves anything.
    Who has control puts its ``key`` in: a command that moves anything and has another key is refused.
    Fields that say nothing are not written: old sketches have 256 bytes for the topic and the payload.
    """

    x: float = 0.0  # steering, positive turns right
    z: float = 0.0  # throttle, positive is forward
    y: float = 0.0  # auxiliary axis, for example MiniLAMP's grousers
    source: str | UnsetType = UNSET  # "autonomy" of a script; anything else counts as a person
    run: Annotated[int, Meta(ge=1, le=LAST_RUN)] | UnsetType = UNSET  # of a script: grows until 2^30 - 1, then from 1
    valid_ms: Annotated[int, Meta(ge=0)] | UnsetType = UNSET  # of a zero, 0: the script must not resume
    key: str | UnsetType = UNSET  # from outgoing/control/{owner}; of several owners all, with blanks between
    t: Annotated[int, Meta(ge=0, le=LARGEST_MS)] | UnsetType = UNSET  # the sender's clock, in milliseconds
    by: str | UnsetType = UNSET  # the account of a sender elsewhere, where the robot checks names
    group: bool | UnsetType = UNSET  # a copy of what a group of commands contained

    def __post_init__(self) -> None:
        if not (-1.0 <= self.x <= 1.0 and -1.0 <= self.z <= 1.0 and -1.0 <= self.y <= 1.0):  # NaN is not within, either
            super().__post_init__()
            _clamp(self, -1.0, 1.0, "x", "z", "y")

    @property
    def moves(self) -> bool:
        """True if any axis is not 0; a command without is called a zero."""
        return self.x != 0.0 or self.z != 0.0 or self.y != 0.0

    def ends(self) -> bool:
        return not self.moves

    @property
    def signed(self) -> bool:
        """True if a script has sent this command."""
        return self.source == SCRIPT


class EstopCommand(Payload, frozen=True, kw_only=True):
    """An emergency stop. ``stop`` is its name: 16 hex digits, new for every press, the same in its repetitions."""

    stop: str | UnsetType = UNSET
    by: str | UnsetType = UNSET  # who stops, at most 32 ASCII characters
    why: str | UnsetType = UNSET  # at most 40
    owner: str | UnsetType = UNSET  # on the robot only: other motor owners of it ignore this repetition


class EstopReset(Payload, frozen=True, kw_only=True):
    """The end of the emergency stop of one motor owner, if ``boot`` and ``count`` are those of its state now."""

    boot: str
    count: int
    by: str | UnsetType = UNSET


class ControlRequest(Payload, frozen=True, kw_only=True, omit_defaults=True):
    """Requests control of all motor owners of a robot, repeated every second, or releases it; their state answers.

    ``by`` and ``device`` are shown to others: small letters, digits, ``_``, ``-`` and ``/``; others become ``_``.
    """

    id: Annotated[str, Meta(pattern=r"\A[0-9A-Fa-f]{8}\Z")]  # new for each tab or process: 8 hex digits
    want: Literal["hold", "release"] = "hold"
    for_ms: float = 3000  # control ends so long after the last request or command: 1,000 to 10,000
    by: str = ""  # who, at most 40 characters
    device: str = ""  # with what, at most 20
    t: Annotated[int, Meta(ge=0, le=LARGEST_MS)] | UnsetType = UNSET  # the sender's clock, in milliseconds

    def __post_init__(self) -> None:
        super().__post_init__()
        force_setattr(self, "by", shown(self.by, 40))
        force_setattr(self, "device", shown(self.device, 20))

    def ends(self) -> bool:
        return self.want == "release"


class LightsSolid(Payload, frozen=True, kw_only=True):
    """A steady colour, each channel 0..1 (paper A.8.4)."""

    b: float = 0.0
    g: float = 0.0
    r: float = 0.0
    group: bool | UnsetType = UNSET  # true: a copy of what a group of commands contained

    def __post_init__(self) -> None:
        super().__post_init__()
        _clamp(self, 0.0, 1.0, "b", "g", "r")


class LightsFlash(LightsSolid, frozen=True, kw_only=True):
    """A colour that fades in and out once every ``period`` seconds (≥ 0.05)."""

    period: float = 2.0

    def __post_init__(self) -> None:
        super().__post_init__()
        _clamp(self, 0.05, math.inf, "period")


STOP_WORDS = frozenset(("stop", "disable", "disabled", "off"))  # as the ``action`` of a command


class Switch(Payload, frozen=True, kw_only=True):
    """A command that starts or stops one thing; ``action`` wins over ``enabled``."""

    action: str | None = None
    enabled: bool | None = None
    file: str | None = None

    def ends(self) -> bool:
        if self.action:
            return self.action.strip().lower() in STOP_WORDS
        return self.enabled is False


class SoundboardCommand(Switch, frozen=True, kw_only=True):
    """Play or stop a clip (paper A.8.10); ``action`` wins over ``enabled``.

    ``repeat`` is how often to play it, or true: until it is stopped. It is not written where it says nothing.
    """

    repeat: Annotated[int, Meta(ge=0)] | bool | UnsetType | None = UNSET  # 0, false, null: once; UNSET: not written


class AutonomyCommand(Switch, frozen=True, kw_only=True, omit_defaults=True):
    """Start or stop one script (paper A.8.11)."""

    config: dict[str, Any] | None = None
    by: str | UnsetType = UNSET  # as of a drive command


class MediaRequest(Payload, frozen=True, kw_only=True, omit_defaults=True):
    """Start or stop remote video or audio; ``encoding`` None or unknown: as configured."""

    enabled: bool
    encoding: str | None = None
    keyframe: bool = False  # request a full picture

    def ends(self) -> bool:
        return not self.enabled


class OutletCommand(Payload, frozen=True, kw_only=True):
    """Switch an outlet; only a JSON boolean switches anything."""

    on: bool

    def ends(self) -> bool:
        return not self.on


# -- outgoing


class Heartbeat(Payload, frozen=True, kw_only=True):
    """Sign of life; as the will it holds ``online: false`` (paper A.8.5).

    A robot without capabilities may list what it obeys, here or in the ``value`` of its status:
    ``"subscribes": ["incoming/drive-values"]``. Pages then offer that, and tell what to publish.
    """

    t: int  # epoch milliseconds
    online: bool | UnsetType = UNSET


class GatewayHeartbeat(Payload, frozen=True, kw_only=True):
    """Sign of life of a gateway, on ``outgoing/online`` of its own identity; as the will the topic is emptied."""

    t: int  # epoch milliseconds; the will has none: it is an empty message, which removes this one
    run: str  # another one at each start
    robots: tuple[str, ...] = ()  # bases of those that it carries


class NeighbourRefusal(Payload, frozen=True, kw_only=True):
    """A run of another robot's script whose commands this robot refuses, and why."""

    run: int
    why: str


class Neighbours(Payload, frozen=True, kw_only=True):
    """The relations of a robot to others of its LAN. Names are those of robots in the config."""

    shares: list[str] = []  # metrics that the others may receive
    commanded: dict[str, list[str]] = {}  # metrics that a script of this robot may command
    receives: dict[str, bool] = {}  # by robot: whether its messages arrive here now
    driven_by: str = ""  # whose script drives this robot, or did last and has not ended; empty: none
    refused: dict[str, NeighbourRefusal] = {}  # by robot: its newest run, while that has no effect


class ChargingStatus(Payload, frozen=True, kw_only=True):
    """The connection to the charger; null: unknown."""

    value: bool | None


class ChargingLevel(Payload, frozen=True, kw_only=True):
    """Battery voltage; some robots send per cent, without a unit."""

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
    """The capabilities of a robot, with its effective topics (paper A.8.6); published again when they change.

    Send ``value`` as CapabilitiesValue has it. One section that is wrong does not make the others unreadable.
    """

    t: int  # epoch milliseconds
    value: dict[str, Any]  # a [CapabilitiesValue](#capabilitiesvalue)
    schema: str = "pebble-capabilities/v1"


class EstopState(Payload, frozen=True, kw_only=True):
    """The emergency stop of one motor owner, at most 400 bytes; of a board 300."""

    latched: bool  # it moves nothing until it is reset
    boot: str  # random at each start of the owner
    count: int  # of the stops since then
    recent: list[str]  # names of the newest stops, the last one first: 8, of a board 4
    by: str
    why: str
    since: int  # epoch milliseconds of the newest stop; 0: none
    reset_refused: Literal["count", "boot", "old"] | None = None  # why the last reset was refused
    persisted: bool | None = None  # whether this survives a power cut; None: the owner cannot save it
    barred: int | UnsetType = UNSET  # no script's run up to this one moves anything

    @property
    def last_barred(self) -> int:
        """The newest barred run: it and all runs before it move nothing any more; 0 if no run is barred."""
        return self.barred if isinstance(self.barred, int) else 0


class ControlState(Payload, frozen=True, kw_only=True):
    """The control of one motor owner, at most 300 bytes; ``key`` is ``""`` while nobody has it.

    Where a robot has several owners, the first one by name decides who drives.
    """

    by: str  # who has control, as its request says
    id: str
    key: str  # random, new whenever another one gets control; for the drive commands of who has it
    device: str = ""
    asks: str = ""  # who asks for control meanwhile, the first one
    asks_id: str = ""  # "": nobody does
    others: bool = False  # a command without a key has moved something in the last 2 s
    named: bool = False  # the broker vouches for the names
    boot: str = ""  # random at each start of the owner, as in its emergency stop


class ControlTurn(Payload, frozen=True, kw_only=True, omit_defaults=True):
    """The grant of the first of several motor owners; of another owner only ``boot`` and ``turn``, which it follows."""

    boot: str  # of the first owner; the others answer with the boot and turn that they follow
    turn: Annotated[int, Meta(ge=0)]  # grows whenever control passes on, also to nobody
    t: Annotated[int, Meta(ge=0, le=LARGEST_MS)] = 0  # when it was sent, by the machine's clock since its start
    key: str = ""
    account: str = ""  # of who has control, where names are checked
    id: str = ""
    by: str = ""
    device: str = ""
    asks: str = ""
    asks_id: str = ""
    others: bool = False
    barred: Annotated[int, Meta(ge=0, le=LAST_RUN)] = 0  # no run up to this one moves anything


class ControlVouched(Payload, frozen=True, kw_only=True):
    """A period in which the bridge has forwarded all messages in time; milliseconds since the machine's start."""

    begin: Annotated[int, Meta(ge=0, le=LARGEST_MS)] = field(name="from")
    end: Annotated[int, Meta(ge=0, le=LARGEST_MS)] = field(name="to")


class LinkState(Payload, frozen=True, kw_only=True):
    """The capacity of the way between a robot and its remote broker, as its bridge measures it."""

    level: LinkLevel
    drive_hz: float  # commands of one operator, a second
    rtt_ms: int  # the shortest round trip of the last minutes
    queue_ms: int  # by so much the newest one was longer: what waits on the way
    t: int  # epoch milliseconds


class Wire(Payload, frozen=True, kw_only=True, omit_defaults=True):
    """The form of a robot's groups of streams; what takes them apart needs nothing else."""

    v: Literal[1] = 1
    group_hz: float  # an expander, which splits the groups, needs only these fields
    named: bool = False  # it takes commands only with an account's name in the topic
    dict_id: Annotated[int, Meta(ge=1, le=31)] | UnsetType = UNSET  # the first byte of groups that need ``dict``
    dict: str | UnsetType = UNSET  # the dictionary of their deflate
    short: str | UnsetType = UNSET  # their topic, once an expander has heard it


class LogRecord(Payload, frozen=True, kw_only=True):
    """One log line (paper A.8.7); ``message`` at most 2048 characters by default."""

    t: int  # epoch milliseconds
    level: str
    service: str
    message: str
    logger: str = "root"
    pid: int = 0


class ServiceState(Payload, frozen=True, kw_only=True):
    """The state of one service process, inside ``Status``."""

    state: Literal["init", "ready", "restarting", "failed", "stopped", "held"]  # held: it waits while people drive
    restarts: int = 0
    last_exit: str | None = None  # for example "exit code 1" or "signal 9"
    restarts_per_minute: int | UnsetType = UNSET  # unexpected exits within the last minute, if there were any


class Status(Payload, frozen=True, kw_only=True):
    """A robot's general state; robots carry ``services``, other components may put anything into ``value``.

    Also ``mcu`` and ``driveable`` where there are serial lines and motors: docs/topics.md.
    """

    t: int | UnsetType = UNSET  # epoch milliseconds
    value: dict[str, Any] = field(default_factory=dict)


class MediaReport(Payload, frozen=True, kw_only=True, omit_defaults=True):
    """The state of one stream (``camera``, ``microphone``) or one media program; other fields are absent."""

    running: bool
    doing: str | None = None  # for people: "h264 640x480, 10 fps, 212 kbit/s"
    encoding: str | None = None
    width: int | None = None  # of what is sent, or captured
    height: int | None = None
    rate: float | None = None  # frames or sound packets per second, over the last seconds
    bitrate: int | None = None  # bits per second sent, over the last seconds
    readers: int | None = None
    fallbacks: int | None = None  # frames that were not sent through shared memory
    dropped: int | None = None  # frames or packets dropped because a reader or the connection was too slow
    restarts: int | None = None  # how often the device was opened again
    reduced: str | None = None  # how it is adapted to a slow connection: "quality 6", "size 1/2", "rate 1/2"
    problem: str | None = None  # what is wrong with what comes at present: "shows the same picture since 7 s"
    last_error: str | None = None  # this, or why there was nothing the last time


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
    """The interfaces of a self-describing MCU, as it reports them."""

    protocol: str
    schema_version: int
    interface_count: int
    schema_hash: str
    device_uid: str
    firmware_version: str
    model: str
    interfaces: list[dict[str, Any]]


class McuLocalOnly(Payload, frozen=True, kw_only=True):
    topics: list[str]  # below the robot's base: outgoing/mcu/lamp-1/temperature


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


#: What a script says of itself before its settings: characters of its summary, and settings that are seen first.
LONGEST_SUMMARY, MOST_MAIN = 160, 3


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
    config: dict[str, Any] | None = None  # the effective settings
    controls: bool = True
    overridden: bool | UnsetType = UNSET  # true while a person drives, and the script has to wait
    label: str | UnsetType = UNSET  # what people call it
    since: float | UnsetType = UNSET  # epoch seconds, of its start
    drives: bool | UnsetType = UNSET  # false: it only measures, and an emergency stop does not end it
    stopped: bool | UnsetType = UNSET  # true: the error is an emergency stop, and ends with the reset


class MotorPower(Payload, frozen=True, kw_only=True):
    left: float  # −1..1
    right: float


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
    of: int | UnsetType = UNSET  # how many tags with this id are in the picture; absent: one


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
