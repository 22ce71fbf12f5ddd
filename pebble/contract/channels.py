"""The topic contract: every channel, declared once.

Topics, delivery rules, bridge routing, capabilities, tables of topics and JSON Schemas are derived from CHANNELS and
written nowhere else. Sources: paper Tables 3.1 and A.2 to A.6.
"""

import math
import re
from enum import Enum
from functools import cached_property, partial
from typing import Any

from msgspec import Struct

from pebble.contract import payloads as p

INCOMING, OUTGOING = "incoming", "outgoing"
WAITS_S = 0.5  # so long a one-shot message may wait in a process or at a broker; in the connection another 2 s
_PATIENT_S = 2.0  # for one that moves nothing
_HOLD_S = 3.0  # for requests for control, which last for 3 s and are repeated every second,
_HOLD_THIN_S = 10.0  # and where the link may be thin: control lasts for as long at most


class Kind(Enum):
    """The meaning of a channel; direction and delivery follow from it: (direction, qos, retain)."""

    COMMAND = (INCOMING, 1, False, "one-shot; a retained one is stale and is never executed or forwarded")
    FLAG = (INCOMING, 1, True, "a switch whose last position matters")
    ACTION = (INCOMING, 1, False, "one-shot under flags/, with a cooldown; never when retained")
    STATE = (OUTGOING, 1, True, "latest known value; repeated on connect, on change and on an interval")
    EVENT = (OUTGOING, 1, False, "something happened")
    STREAM = (OUTGOING, 0, False, "freshness first; drop the oldest")
    FEED = (INCOMING, 0, False, "a stream sent to the robot")

    __hash__ = object.__hash__  # in C, not in Python: kinds are looked up several times for each message

    def __init__(self, direction: str, qos: int, retain: bool, meaning: str) -> None:
        self.direction, self.qos, self.retain, self.meaning = direction, qos, retain, meaning
        #: True if a message means something that happens once: a retained one is stale.
        self.one_shot = direction == INCOMING and not retain


class Channel(Struct, frozen=True, kw_only=True, dict=True):
    """A topic, or a family of topics: its name, payload and delivery.

    ``metric`` may hold placeholders ``{name}``, each for one topic level. With ``remote=False`` messages never leave
    the robot. With ``bridged=False`` the publishing process has a remote connection of its own: the bridge does not
    forward the topic. With ``newest``, only the newest of several waiting messages is handled. A one-shot message that
    has waited for longer than ``waits_s`` in a process or at a broker (``thin_waits_s`` over a link that may be thin)
    is stale and ignored, except if it ends something (a zero, a release). A ``prompt`` message never waits for room on
    a thin link.
    """

    metric: str
    kind: Kind
    payload: Any
    doc: str = ""
    rate_hz: float = 0.0  # nominal; 0 means on demand
    remote: bool = True
    bridged: bool = True
    newest: bool = False
    waits_s: float = WAITS_S
    thin_waits_s: float | None = None  # None: the same
    prompt: bool = False
    qos: int = -1  # -1: that of the kind
    retain: bool | None = None  # None: that of the kind
    override: str | None = None  # the dotted path of the config's key that may rename it (paper Table A.6)
    synonym_of: str | None = None  # another name for this metric: understood, never published

    @property
    def direction(self) -> str:
        return self.kind.direction

    @property
    def default_qos(self) -> int:
        return self.kind.qos if self.qos < 0 else self.qos

    @property
    def default_retain(self) -> bool:
        return self.kind.retain if self.retain is None else self.retain

    @property
    def one_shot(self) -> bool:
        return self.kind.one_shot

    @cached_property
    def is_pattern(self) -> bool:
        return "{" in self.metric

    @cached_property
    def suffix(self) -> str:
        """The topic below the identity: ``incoming/drive-values``."""
        return f"{self.direction}/{self.metric}"

    def topic(self, base: str, **names: str) -> str:
        """Return the default topic of a robot, for example ``topic("pebble/robots/goob")``."""
        return f"{base}/{self.suffix.format(**names)}" if names else f"{base}/{self.suffix}"

    def filter(self, base: str) -> str:
        """Return the filter that receives this channel of ``base``, which may hold ``+`` levels."""
        return f"{base}/{re.sub(r'{[^}]*}', '+', self.suffix)}"

    def ends(self, value: Any) -> bool:
        """True if ``value``, a payload of this channel, can only end something, such as a zero drive command."""
        return issubclass(self.payload, p.Payload) and value.ends()

    def names(self, topic: str) -> dict[str, str]:
        """Return the values of this pattern's placeholders in ``topic``: ``{"program": "camera_publisher"}``."""
        pattern = re.sub(r"{([^}]*)}", r"(?P<\1>[^/]+)", self.suffix)  # each placeholder becomes a group of its name
        match = re.search(pattern + r"\Z", topic)
        return match.groupdict() if match is not None else {}


def _c(metric: str, kind: Kind, payload: Any, doc: str, **more: Any) -> Channel:
    return Channel(metric=metric, kind=kind, payload=payload, doc=doc, **more)


def _service(name: str, key: str) -> str:
    return f"services.{name}.topics.{key}"


_serial, _bridge = partial(_service, "serial_mcu_bridge"), partial(_service, "mqtt_bridge")
_MEDIA = "services.mqtt_bridge.media"

# -- incoming: motion, stops and lights
DRIVE = _c("drive-values", Kind.COMMAND, p.Drive, "Wanted steering x and throttle z, each -1..1; optional y.",
           rate_hz=20, newest=True, override=_serial("drive_values"))  # fmt: skip
ESTOP = _c("estop", Kind.COMMAND, p.EstopCommand, "Emergency stop: nothing moves until a reset.", waits_s=math.inf)
ESTOP_RESET = _c("estop-reset", Kind.COMMAND, p.EstopReset, "Ends the emergency stop of one motor owner.")
CONTROL = _c("control", Kind.COMMAND, p.ControlRequest, "Requests, renews or releases control: who drives.",
             waits_s=_HOLD_S, thin_waits_s=_HOLD_THIN_S)  # fmt: skip
CONTROL_TAKE = _c("control/take", Kind.COMMAND, p.ControlRequest, "Takes control over from somebody else.",
                  waits_s=_HOLD_S, thin_waits_s=_HOLD_THIN_S)  # fmt: skip
LIGHTS_SOLID = _c("lights-solid", Kind.COMMAND, p.LightsSolid, "A steady colour.",
                  newest=True, waits_s=_PATIENT_S, override=_serial("lights_solid"))  # fmt: skip
LIGHTS_FLASH = _c("lights-flash", Kind.COMMAND, p.LightsFlash, "A colour fading in and out.",
                  newest=True, waits_s=_PATIENT_S, override=_serial("lights_flash"))  # fmt: skip
GROUP = _c("group", Kind.COMMAND, p.AnyObject, "Several commands by their metrics: all are carried out, or none.")
EXPANDER = _c("expander", Kind.COMMAND, p.AnyObject, "Someone beside the broker takes groups of streams apart.")

# -- incoming: media, sounds, scripts
VIDEO_CONTROL = _c("front-camera", Kind.COMMAND, p.MediaRequest, "Start or stop remote video.",
                   waits_s=_PATIENT_S, override=_bridge("video_control"))  # fmt: skip
AUDIO_CONTROL = _c("audio", Kind.COMMAND, p.MediaRequest, "Start or stop remote audio, both directions.",
                   waits_s=_PATIENT_S, override=_bridge("audio_control"))  # fmt: skip
AUDIO_STREAM = _c("audio-stream", Kind.FEED, bytes, "An operator's voice as PBAT packets.",
                  rate_hz=50, bridged=False, override=f"{_MEDIA}.audio_receiver.topic")  # fmt: skip
SOUNDBOARD_COMMAND = _c("soundboard-command", Kind.COMMAND, p.SoundboardCommand, "Play or stop a sound clip.",
                        waits_s=_PATIENT_S, override=_service("soundboard_handler", "command"))  # fmt: skip
AUTONOMY_COMMAND = _c("autonomy-command", Kind.COMMAND, p.AutonomyCommand, "Start or stop an autonomy script.",
                      override=_service("autonomy_manager", "command"))  # fmt: skip

# -- incoming: flags and actions
REMOTE_MIRROR = _c("flags/remote-mirror", Kind.FLAG, bool, "Mirror all local incoming traffic to the remote broker.",
                   override=_bridge("remote_mirror"))  # fmt: skip
MQTT_AUDIO = _c("flags/mqtt-audio", Kind.FLAG, bool, "Allow remote audio.", override=_bridge("mqtt_audio"))
MQTT_VIDEO = _c("flags/mqtt-video", Kind.FLAG, bool, "Allow remote video.", override=_bridge("mqtt_video"))
REBOOT = _c("flags/reboot", Kind.ACTION, bool, "Restart the computer.", override=_bridge("reboot"))
SERVICE_RESTART = _c("flags/service-restart", Kind.ACTION, bool, "Restart Pebble.",
                     override=_bridge("service_restart"))  # fmt: skip
GIT_PULL = _c("flags/git-pull", Kind.ACTION, bool, "Update the software.", override=_bridge("git_pull"))

# -- incoming: devices
OUTLET_COMMAND = _c("outlets/{outlet}/power", Kind.COMMAND, p.OutletCommand, "Switch an outlet.")
MCU_COMMAND = _c("mcu/{uid}/{name}", Kind.COMMAND, p.AnyObject, "A command to a self-describing MCU.")
MIP_RAW = _c("mip-raw", Kind.COMMAND, bytes, "Bytes for a MiP's own UART, as hex text or an object; only MiP reads it.")

# -- outgoing: supervision
ONLINE = _c("online", Kind.STATE, p.Heartbeat, "Heartbeat, and as the will: offline.",
            rate_hz=4, override="services.mqtt_bridge.heartbeat.topic")  # fmt: skip
HEARTBEAT = _c("heartbeat", Kind.STATE, p.Heartbeat, "Older name of the heartbeat.", synonym_of="online")
CAPABILITIES = _c("capabilities", Kind.STATE, p.Capabilities, "What the robot can do, and under which topics.",
                  override="services.launcher.capabilities.topic")  # fmt: skip
STATUS = _c("status", Kind.STATE, p.Status, "General state; robots list the state of their services.")
ESTOP_STATE = _c("estop/{owner}", Kind.STATE, p.EstopState, "Whether a motor owner is stopped, and by whom.",
                 prompt=True)  # fmt: skip
CONTROL_STATE = _c("control/{owner}", Kind.STATE, p.ControlState,
                   "Who has control of a motor owner, and who asks for it.", prompt=True)  # fmt: skip
CONTROL_TURN = _c("control-turn/{owner}", Kind.EVENT, p.ControlTurn,
                  "Where a robot has several motor owners: what the first grants, and what the others follow.",
                  rate_hz=2, remote=False)  # fmt: skip
CONTROL_VOUCHED = _c("control-vouched", Kind.EVENT, p.ControlVouched,
                     "Over which time the bridge has passed on in time all that it was sent.",
                     rate_hz=2, remote=False)  # fmt: skip
STREAMS = _c("group", Kind.STREAM, bytes, "The newest of several streams; deflated with a dictionary of `wire`.")
WIRE = _c("wire", Kind.STATE, p.Wire, "How the streams in a group are written.")
SHORT = "~/"  # begins the topic of groups of streams, before a robot's short name
LINK = _c("link", Kind.STATE, p.LinkState, "What the link to the remote broker carries; only where it may be thin.")
BRIDGE_PROBE = _c(
    "bridge-probe",
    Kind.EVENT,
    p.AnyObject,
    "By it the bridge detects that two of the robot's connections lead to one broker.",
)
LOGS = _c("logs", Kind.STREAM, p.LogRecord, "Log lines of all services.", override="services.launcher.logs.topic")

# -- outgoing: telemetry
CHARGING_STATUS = _c("charging-status", Kind.STATE, p.ChargingStatus, "On the charger: true, false or unknown.",
                     override=_serial("charging_status"))  # fmt: skip
CHARGING_LEVEL = _c("charging-level", Kind.STATE, p.ChargingLevel, "Battery voltage.",
                    rate_hz=0.2, override=_serial("charging_level"))  # fmt: skip
MOTOR_POWER = _c("motor-power/{owner}", Kind.STREAM, p.MotorPower,
                 "What a motor owner commands its wheels, for odometry.",
                 rate_hz=20, qos=1, remote=False)  # fmt: skip
TOUCH_SENSORS = _c("touch-sensors", Kind.STREAM, p.TouchSensors, "Raw touch or hall readings.",
                   rate_hz=50, qos=1, override=_serial("touch_sensors"))  # fmt: skip
IMU_FAST = _c("sensors/imu-fast", Kind.STREAM, p.ImuFast, "Every sample of the inertial sensor.",
              rate_hz=100, remote=False,
              override=_serial("high_rate"))  # fmt: skip
IMU = _c("sensors/imu", Kind.STREAM, p.Imu, "Summary of the inertial sensor.", rate_hz=5, qos=1,
         override=_serial("low_rate"))  # fmt: skip
MCU_DESCRIBE = _c("mcu/{uid}/describe", Kind.STATE, p.McuManifest, "Manifest of a self-describing MCU.")
MCU_LOCAL_ONLY = _c("mcu/{uid}/local-only", Kind.STATE, p.McuLocalOnly,
                    "The topics of a self-describing MCU that stay on the robot.", remote=False)  # fmt: skip
MCU_VALUE = _c("mcu/{uid}/{name}", Kind.STREAM, p.McuSample,
               "A value of a self-describing MCU; its manifest defines QoS and retain.")  # fmt: skip
OUTLET_STATUS = _c("outlets/{outlet}/status", Kind.STATE, p.OutletStatus, "State of an outlet.")

# -- outgoing: media
CAMERA = _c("front-camera", Kind.STREAM, bytes, "Pictures: JSON, PBVD or JPEG, distinguished by their first bytes.",
            rate_hz=15, bridged=False, override=f"{_MEDIA}.video_publisher.topic")  # fmt: skip
AUDIO = _c("audio", Kind.STREAM, bytes, "Sound as PBAT packets.", rate_hz=50, bridged=False,
           override=f"{_MEDIA}.audio_publisher.topic")  # fmt: skip
MEDIA_STATUS = _c("media-status", Kind.STATE, p.MediaStatus, "State of camera, microphone and media programs.")
MEDIA_REPORT = _c("media-report/{program}", Kind.EVENT, p.MediaReport,
                  "State of one media program; becomes part of media-status.", rate_hz=1, remote=False)  # fmt: skip
VIDEO_OVERLAYS = _c("video-overlays", Kind.STREAM, p.VideoOverlays, "Shapes and labels to draw over the picture.",
                    rate_hz=12, override=f"{_MEDIA}.video_publisher.overlays_topic")  # fmt: skip

# -- outgoing: sounds and scripts
SOUNDBOARD_FILES = _c("soundboard-files", Kind.STATE, p.SoundboardFiles, "The clips a robot can play.",
                      override=_service("soundboard_handler", "files"))  # fmt: skip
SOUNDBOARD_STATUS = _c("soundboard-status", Kind.STATE, p.SoundboardStatus, "What is playing.",
                       override=_service("soundboard_handler", "status"))  # fmt: skip
AUTONOMY_FILES = _c("autonomy-files", Kind.STATE, p.AutonomyFiles, "The scripts a robot can run, and their options.",
                    override=_service("autonomy_manager", "files"))  # fmt: skip
AUTONOMY_STATUS = _c("autonomy-status", Kind.STATE, p.AutonomyStatus, "Which script is running.",
                     override=_service("autonomy_manager", "status"))  # fmt: skip

# -- outgoing: perception and navigation
WHEEL_ODOMETRY = _c("wheel-odometry", Kind.STREAM, p.WheelOdometry, "Position from the wheels.", rate_hz=20)
APRILTAG_LOCATIONS = _c("apriltag-locations", Kind.STREAM, p.TagLocations, "AprilTags in the picture.", rate_hz=12)
APRILTAG_DATA = _c("apriltag-data", Kind.STREAM, p.TagData, "The tag being followed.", rate_hz=10)
LOCALIZATION_POSE = _c("localization-pose", Kind.STREAM, p.AnyObject, "Pose from a ROS robot.", rate_hz=4)
NAVIGATION_STATUS = _c("navigation-status", Kind.STATE, p.AnyObject, "What a ROS planner is doing.", rate_hz=2)
NAVIGATION_GOAL = _c("navigation-goal", Kind.STATE, p.AnyObject, "Where a ROS planner is going.")
NAVIGATION_LOCAL_PLAN = _c("navigation/local-plan", Kind.STREAM, p.AnyObject, "Next steps of a ROS planner.")
NAVIGATION_GLOBAL_PLAN = _c("navigation/global-plan", Kind.STREAM, p.AnyObject, "Whole route of a ROS planner.")
DIAGNOSTICS = _c("diagnostics", Kind.STATE, p.AnyObject, "Diagnostics of a ROS robot.", rate_hz=1)

# -- between robots of a LAN: docs/ext/neighbours.md
FROM_NEIGHBOUR = _c("from/{robot}/drive-values", Kind.COMMAND, p.Drive,
                    "What a script of another robot drives, at the hub of the LAN; only `neighbours` reads it.",
                    rate_hz=20, newest=True, remote=False)  # fmt: skip
TO_NEIGHBOUR = _c("to/{robot}/drive-values", Kind.COMMAND, p.Drive,
                  "What a script of this robot wants another one to do; only `neighbours` reads it.",
                  rate_hz=20, newest=True, remote=False)  # fmt: skip
NEIGHBOURS = _c("neighbours", Kind.STATE, p.Neighbours, "Which robots this one receives from, and which may drive it.")
NEIGHBOUR_VALUE = _c("neighbours/{robot}/{metric}", Kind.STREAM, bytes,
                     "What another robot of the LAN publishes, as it does, for scripts of this one.",
                     remote=False)  # fmt: skip

#: Families of topics that pass neither to operators nor to a mirror.
BETWEEN_ROBOTS = (f"{INCOMING}/from/", f"{INCOMING}/to/", f"{OUTGOING}/neighbours/")

CHANNELS: tuple[Channel, ...] = tuple(value for value in list(vars().values()) if isinstance(value, Channel))
_EXACT = {channel.suffix: channel for channel in CHANNELS if not channel.is_pattern}
_PATTERNS = [
    (re.compile(re.sub(r"{[^}]*}", "[^/]+", channel.suffix)), channel) for channel in CHANNELS if channel.is_pattern
]


_RESERVED = frozenset(("by", "control", "control-turn", "control-vouched", "from", "to", "neighbours"))


def is_reserved(metric: str) -> bool:
    """True if ``metric`` belongs to stops, control or neighbours, so that only the robot itself may define it."""
    family = metric.partition("/")[0]
    return family.startswith("estop") or family in _RESERVED


def channel_of(suffix: str) -> Channel | None:
    """Return the channel whose default topic ends in ``suffix`` (``incoming/drive-values``), or None."""
    exact = _EXACT.get(suffix)
    if exact is not None:
        return exact
    return next((channel for pattern, channel in _PATTERNS if pattern.fullmatch(suffix)), None)
