"""The sections of a robot's config file: every key with its default, its limits and its meaning."""

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal, get_args

from msgspec import Meta, defstruct, field
from msgspec.structs import fields

from pebble.config.security import Security
from pebble.config.transport import Mqtt, RemoteConnection, RemoteMqtt, TransportSection
from pebble.config.types import (
    BY_CONTRACT,
    EMPTY,
    EXACT,
    ONE_VALUE,
    Cells,
    Command,
    Device,
    File,
    Interval,
    Label,
    Level,
    LogLevel,
    Seconds,
    Section,
    Sentence,
    ServiceSection,
    SharedMemoryName,
    Topic,
    Variables,
    doc,
)
from pebble.contract.looks import Body, Colour
from pebble.contract.payloads import LinkLevel
from pebble.contract.serial_protocols import SERIAL_PROTOCOLS


class Robot(Section, frozen=True, kw_only=True):
    """The robot's identity: its topics begin with `{system}/{type}/{id}`."""

    id: Annotated[Level, doc("The robot's own name.")]
    system: Annotated[Level, doc("First level of all topics.")] = "pebble"
    type: Annotated[Level, doc("Second level of all topics: the kind of component.")] = "robots"
    platform: Annotated[
        Literal["linux", "esp32", "esp8266"],
        doc("What it runs on. The MCU platforms run their own firmware: `pebble up` does not start them."),
    ] = "linux"
    name: Annotated[Label | None, doc("What people call it; its id unless set.")] = None
    description: Annotated[Sentence | None, doc("What it is, for the operator page.")] = None
    colour: Annotated[Colour | None, doc("Its colour on the operator page; by its id unless set.")] = None
    picture: Annotated[Body | None, doc("The drawing that stands for it on the operator page.")] = None
    battery_cells: Annotated[
        Cells | None, doc("Lithium cells in series: with it the operator page shows percent, not volts.")
    ] = None


class Defaults(Section, frozen=True, kw_only=True):
    """Values for several services."""

    retained_publish_interval_seconds: Annotated[Interval, doc("How often retained state is published again.")] = 3600.0


class CapabilitiesSection(Section, frozen=True, kw_only=True):
    """The message that lists what the robot can do."""

    retired: ClassVar = {
        "publish_interval_seconds": "services.defaults has one for all",
        "enabled": "services.launcher.enabled is for capabilities and logs",
        **BY_CONTRACT,
    }

    topic: Annotated[Topic | None, doc("Instead of `{base}/outgoing/capabilities`.")] = None


class LogsSection(Section, frozen=True, kw_only=True):
    """Log lines of all services as messages."""

    retired: ClassVar = {"min_level": ONE_VALUE, "max_message_chars": ONE_VALUE, **BY_CONTRACT}

    enabled: Annotated[bool, doc("Publish them.")] = True
    topic: Annotated[Topic | None, doc("Instead of `{base}/outgoing/logs`.")] = None


class Launcher(ServiceSection, frozen=True, kw_only=True):
    """Starts, supervises and stops the other services."""

    enabled: Annotated[bool, doc("Publish capabilities and logs.")] = True
    restart_delay_seconds: Annotated[
        Seconds, doc("Scales the waits between restarts: none, then a quarter of this, doubling up to 5 times it.")
    ] = 2.0
    shutdown_timeout_seconds: Annotated[
        Seconds, doc("How long the whole robot may take to stop; then the remaining processes are killed.")
    ] = 8.0
    capabilities: Annotated[CapabilitiesSection, doc("What the robot can do.")] = CapabilitiesSection()
    logs: Annotated[LogsSection, doc("Log lines as messages.")] = LogsSection()


class BridgeTopics(Section, frozen=True, kw_only=True):
    """Other topics for what the bridge subscribes to; unset: `{base}/incoming/…`."""

    remote_mirror: Annotated[Topic | None, doc("Instead of `{base}/incoming/flags/remote-mirror`.")] = None
    mqtt_audio: Annotated[Topic | None, doc("Instead of `{base}/incoming/flags/mqtt-audio`.")] = None
    mqtt_video: Annotated[Topic | None, doc("Instead of `{base}/incoming/flags/mqtt-video`.")] = None
    reboot: Annotated[Topic | None, doc("Instead of `{base}/incoming/flags/reboot`.")] = None
    service_restart: Annotated[Topic | None, doc("Instead of `{base}/incoming/flags/service-restart`.")] = None
    git_pull: Annotated[Topic | None, doc("Instead of `{base}/incoming/flags/git-pull`.")] = None
    audio_control: Annotated[Topic | None, doc("Instead of `{base}/incoming/audio`.")] = None
    video_control: Annotated[Topic | None, doc("Instead of `{base}/incoming/front-camera`.")] = None


class Heartbeat(Section, frozen=True, kw_only=True):
    """The robot's sign of life towards operators."""

    retired: ClassVar = BY_CONTRACT

    enabled: Annotated[bool, doc("Send it.")] = True
    topic: Annotated[Topic | None, doc("Instead of `{base}/outgoing/online`.")] = None
    interval_seconds: Annotated[float, Meta(ge=0.05, le=3600, description="Seconds between two of them.")] = 0.25


class SystemControl(Section, frozen=True, kw_only=True):
    """A command of the operating system that one flag runs, without a shell."""

    retired: ClassVar = {
        "cooldown_seconds": ONE_VALUE,
        "ignore_retained": "a retained request is stale: it is always refused",
    }

    command: Annotated[Command, doc("The program and its arguments; unset: the flag does nothing.")] = ()
    cwd: Annotated[File | None, doc("Folder to run it in; unset: the service's own.")] = None
    env: Annotated[Variables, doc("Environment variables to add.")] = EMPTY


_MEDIA_PROGRAMS = "the media services choose their programs, and services.mqtt_bridge.media configures them"


class Link(Section, frozen=True, kw_only=True):
    """The capacity of the way to the remote broker, and what is sent accordingly; `docs/thin-links.md` explains it."""

    profile: Annotated[
        Literal["wide", "thin", "auto"], doc("`wide`: it carries everything; `thin`: little; `auto`: by measurement.")
    ] = "wide"
    kbit: Annotated[Annotated[float, Meta(gt=0)] | None, doc("What it carries, in kbit/s, if that is known.")] = None
    groups: Annotated[bool, doc("Take several commands in one message.")] = False
    group_hz: Annotated[
        Annotated[float, Meta(ge=0, le=10)], doc("Send streams together, so often a second; 0: each by itself.")
    ] = 0.0
    short: Annotated[Level | None, doc("Send them on `~/SHORT`, with fewer bytes.")] = None

    @property
    def slowest(self) -> LinkLevel:
        """Lowest level that the link may have, for programs that wait for an answer without knowing the level."""
        return "wide" if self.profile == "wide" else "thin"


class MqttBridge(ServiceSection, frozen=True, kw_only=True):
    """The robot's connection to its operators: heartbeat, forwarding, flags and system commands."""

    retired: ClassVar = dict.fromkeys(("video_control", "audio_control"), _MEDIA_PROGRAMS)

    remote_mqtt: Annotated[RemoteMqtt, doc("The remote broker, which operators connect to.")] = RemoteMqtt()
    remote: Annotated[RemoteConnection | None, doc("Used instead of remote_mqtt when set.")] = None
    topics: Annotated[BridgeTopics, doc("Other names for topics.")] = BridgeTopics()
    heartbeat: Annotated[Heartbeat, doc("Sign of life.")] = Heartbeat()
    link: Annotated[Link, doc("A thin link.")] = Link()
    media: Annotated[dict[str, Any], doc("Pictures and sound, to and from operators; an extension reads them.")] = EMPTY
    reboot_control: Annotated[
        SystemControl, doc("What `flags/reboot` runs, for example `systemctl --no-ask-password reboot`.")
    ] = SystemControl()
    service_restart_control: Annotated[
        SystemControl,
        doc("What `flags/service-restart` runs, for example `systemctl --no-block restart pebble.service`."),
    ] = SystemControl()
    git_pull_control: Annotated[
        SystemControl,
        doc("What `flags/git-pull` runs, for example `systemctl --no-ask-password start pebble-update.service`."),
    ] = SystemControl()


class SerialPort(Section, frozen=True, kw_only=True):
    """The line to the MCU."""

    retired: ClassVar = {"timeout_seconds": ONE_VALUE}

    port: Annotated[Device | None, doc("Device: `ls /dev/serial/by-id/*`; required where the bridge is enabled.")] = (
        None
    )
    baud: Annotated[int, Meta(ge=50, le=12_000_000, description="Bits per second; must be the firmware's."), EXACT] = (
        115200
    )


class SerialTelemetry(Section, frozen=True, kw_only=True):
    """The MCU's reports that are published."""

    publish_touch_sensors: Annotated[bool, doc("Publish every touch report, up to 50 per second.")] = False


class OdometryRing(Section, frozen=True, kw_only=True):
    """The shared memory in which the original's `wheel-odometry` finds every raw hall-sensor sample."""

    retired: ClassVar = {"slots": ONE_VALUE}

    enabled: Annotated[bool, doc("Write it.")] = True
    name: Annotated[SharedMemoryName | None, doc("Its name; unset: `{system}_{type}_{id}_odometry_raw`.")] = None


class SerialSafety(Section, frozen=True, kw_only=True):
    """Limits after which the wheels are stopped."""

    retired: ClassVar = {
        "ignore_retained_drive": "a retained drive command is stale: it is always refused",
        "stop_on_shutdown": "a stop is always sent as the last line",
    }

    # 5 s is the limit of the original's MCU firmware.
    drive_timeout_seconds: Annotated[
        float,
        Meta(gt=0, le=5, description="No drive command for this long: stop. Our MCUs stop by themselves after 1 s."),
    ] = 0.75


class SerialTopics(Section, frozen=True, kw_only=True):
    """Other topics for the MCU's reports and commands; unset: the contract's."""

    drive_values: Annotated[Topic | None, doc("Instead of `{base}/incoming/drive-values`.")] = None
    lights_solid: Annotated[Topic | None, doc("Instead of `{base}/incoming/lights-solid`.")] = None
    lights_flash: Annotated[Topic | None, doc("Instead of `{base}/incoming/lights-flash`.")] = None
    touch_sensors: Annotated[Topic | None, doc("Instead of `{base}/outgoing/touch-sensors`.")] = None
    charging_status: Annotated[Topic | None, doc("Instead of `{base}/outgoing/charging-status`.")] = None
    charging_level: Annotated[Topic | None, doc("Instead of `{base}/outgoing/charging-level`.")] = None
    high_rate: Annotated[Topic | None, doc("Instead of `{base}/outgoing/sensors/imu-fast`.")] = None
    low_rate: Annotated[Topic | None, doc("Instead of `{base}/outgoing/sensors/imu`.")] = None


class SerialBridge(ServiceSection, frozen=True, kw_only=True):
    """A serial line to an MCU, and further lines as instances of it; one process each."""

    retired: ClassVar = {
        "health": "a device that is gone is searched for, and an IMU that is silent is restarted",
        "publish": "the contract fixes QoS and retain flag",
    }

    protocol: Annotated[str, Meta(extra={"choices": SERIAL_PROTOCOLS}), doc("The serial protocol of the MCU.")] = (
        "goob_base_v1"
    )
    serial: Annotated[SerialPort, doc("The line.")] = SerialPort()
    telemetry: Annotated[SerialTelemetry, doc("What is published.")] = SerialTelemetry()
    odometry_shm: Annotated[
        OdometryRing | None, doc("Hall samples for the original's `wheel-odometry`; absent: none, `{}`: as below.")
    ] = None
    safety: Annotated[SerialSafety, doc("When to stop.")] = SerialSafety()
    topics: Annotated[SerialTopics, doc("Other names for topics.")] = SerialTopics()
    aliases: Annotated[
        dict[str, str],
        doc('Which of several boards has a channel, by its uid: `{"sensors/imu": "imu-1"}`; unset: neither of two.'),
    ] = EMPTY
    instances: Annotated[
        dict[str, "SerialBridge"], doc("Further lines by name, each with the keys that differ from this section.")
    ] = EMPTY


class Services(Section, frozen=True, kw_only=True):
    """Sections of services, one each; extensions add theirs."""

    holds_others: ClassVar = True

    defaults: Annotated[Defaults, doc("Values for several services.")] = Defaults()
    launcher: Annotated[Launcher, doc("Starts the others.")] = Launcher()
    mqtt_bridge: Annotated[MqttBridge, doc("Connection to operators.")] = MqttBridge()
    serial_mcu_bridge: Annotated[SerialBridge, doc("Serial line to the motor MCU.")] = SerialBridge()


class ExtensionEntry(Section, frozen=True, kw_only=True):
    """An extension of another package, or a file of yours."""

    drives: Annotated[bool, doc("It owns motors: without it the robot does not start.")] = False


class Root(Section, frozen=True, kw_only=True):
    """The top of the file; extensions add their sections."""

    holds_others: ClassVar = True

    schema_: Annotated[str | None, doc("Where editors find the JSON Schema; not used otherwise.")] = field(
        name="$schema", default=None
    )
    log_level: Annotated[LogLevel, doc("How much is logged.")] = "INFO"
    robot: Annotated[Robot, doc("The robot's identity.")]
    local_mqtt: Annotated[Mqtt, doc("The broker inside the robot; used where transport.kind is mqtt.")] = Mqtt()
    transport: Annotated[TransportSection, doc("How messages move inside the robot; absent: MQTT.")] = TransportSection(
        kind="mqtt"
    )
    security: Annotated[Security, doc("Who may do what.")] = Security()
    services: Annotated[Services, doc("One section per service.")] = Services()
    extensions: Annotated[
        dict[str, ExtensionEntry], doc("Extensions of other packages by name, and files such as `lamp.py`.")
    ] = EMPTY


def tree_of(sections: Mapping[str, type[Section]], kind: type[Section] = Root) -> Any:
    """Return a subclass of ``kind``, by default of the class of a whole file, with the sections of extensions.

    They come by key: ``lamp`` is a section of ``kind``, ``services.lamp`` adds ``lamp`` to its section ``services``.
    """
    added: list[tuple[str, Any]] = []  # keys with their annotations: new ones, and those whose section gets more keys
    for key, section in sections.items():
        if "." not in key:
            added.append((key, Annotated[section, doc(section.meaning())]))
    for key_field in fields(kind):  # a section among them may get sections of extensions
        start = f"{key_field.name}."
        inner = {key.removeprefix(start): section for key, section in sections.items() if key.startswith(start)}
        if inner:
            section, *metas = get_args(key_field.type)  # the parts of Annotated[section, *metas]
            added.append((key_field.name, Annotated[tree_of(inner, section), *metas]))
    with_defaults = [(key, annotation, get_args(annotation)[0]()) for key, annotation in added]  # [0]: the class
    namespace = {"__doc__": kind.__doc__, "__module__": kind.__module__}
    return defstruct(kind.__name__, with_defaults, bases=(kind,), namespace=namespace, frozen=True, kw_only=True)
