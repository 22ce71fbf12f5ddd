"""The config section of a base with ROS 1, with the keys of the original Pebble's bridge to ROS."""

import os
from collections.abc import Iterator
from typing import Annotated, ClassVar
from urllib.parse import urlsplit

from msgspec import UNSET, Meta
from msgspec.structs import replace

from pebble.config import Config
from pebble.config.hosts import is_loopback
from pebble.config.problems import Path
from pebble.config.reader import Reader, Rule
from pebble.config.types import BY_CONTRACT, EXACT, Host, Section, ServiceSection, doc
from pebble.contract.capabilities import CapabilitiesValue, TelemetryOffer
from pebble.extension import Facts, Program, Stage

NONE = "none"

RosName = Annotated[
    str, Meta(pattern=r"^/?[A-Za-z]\w*(/[A-Za-z]\w*)*$(?!\n)", extra={"expected": "a name of ROS such as /cmd_vel"})
]
MasterUri = Annotated[
    str,
    Meta(
        pattern=r"^http://[A-Za-z0-9._-]+:\d{1,5}/?$(?!\n)",
        extra={"expected": 'the address of a ROS master such as "http://192.168.1.7:11311"'},
    ),
    EXACT,
]
Period = Annotated[float, Meta(ge=0.05, le=3600)]


class Driving(Section, frozen=True, kw_only=True):
    """Driving the base."""

    enabled: Annotated[bool, doc("Drive it; false: only its telemetry is read, and nothing is sent.")] = True
    cancels_navigation: Annotated[
        bool, doc("A person who drives cancels the goals of a planner, which a multiplexer may prefer to people.")
    ] = True


class Ros(Section, frozen=True, kw_only=True):
    """The node, and the names of its topics in ROS."""

    master_uri: Annotated[
        MasterUri | None, doc("Unset: `ROS_MASTER_URI` of the environment, else http://127.0.0.1:11311.")
    ] = None
    host: Annotated[
        Host | None,
        EXACT,
        doc("Where other nodes reach this one; unset: `ROS_IP` or `ROS_HOSTNAME`, else this machine alone."),
    ] = None
    node_name: Annotated[RosName, doc("The name of the node.")] = "pebble_ros1_bridge"
    cmd_vel_topic: Annotated[RosName, doc("What the base obeys.")] = "/cmd_vel"
    cmd_vel_publish_interval_seconds: Annotated[
        float, Meta(ge=0, le=1), doc("How often a command is repeated while it is valid; 0: every 0.05 s.")
    ] = 0.05
    estop_topic: Annotated[
        RosName, doc('The lock of its multiplexer, a Bool: true while a stop lasts. "none": there is none.')
    ] = "/e_stop"
    cancel_topic: Annotated[RosName, doc('Where goals are cancelled; "none": nowhere.')] = "/move_base/cancel"
    odometry_topic: Annotated[RosName, doc("Its odometry: without it the base is taken for hung.")] = (
        "/odometry/filtered"
    )
    navigation_status_topic: Annotated[RosName, doc("What its planner does.")] = "/move_base/status"
    navigation_goal_topic: Annotated[RosName, doc("Where its planner goes.")] = "/move_base/current_goal"
    navigation_local_plan_topic: Annotated[RosName, doc("The next steps.")] = (
        "/move_base/TrajectoryPlannerROS/local_plan"
    )
    navigation_global_plan_topic: Annotated[RosName, doc("The whole route.")] = "/move_base/NavfnROS/plan"
    diagnostics_topic: Annotated[RosName, doc("Its diagnostics, and its battery.")] = "/diagnostics_agg"


class Motion(Section, frozen=True, kw_only=True):
    """The speeds of a stick at its end."""

    max_linear_speed_mps: Annotated[float, Meta(ge=0, le=20), doc("Metres a second ahead.")] = 0.6
    max_angular_speed_radps: Annotated[float, Meta(ge=0, le=20), doc("Radians a second.")] = 1.2


class Safety(Section, frozen=True, kw_only=True):
    """Limits after which the base is stopped."""

    retired: ClassVar = {
        "ignore_retained_drive": "a retained command is always refused",
        "stop_on_shutdown": "a stop is always sent last",
    }

    drive_timeout_seconds: Annotated[
        float,
        Meta(gt=0, le=5),
        doc("No drive command for this long: stop. A page of the original repeats every 0.5 s."),
    ] = 0.75


class Metric(Section, frozen=True, kw_only=True):
    """A metric that the base publishes."""

    retired: ClassVar = BY_CONTRACT

    enabled: Annotated[bool, doc("Publish it.")] = True


class Sampled(Metric, frozen=True, kw_only=True):
    """A metric that is published now and then."""

    interval_seconds: Annotated[Period, doc("Seconds between two messages, at least.")] = 0.25


class StatusMetric(Sampled, frozen=True, kw_only=True):
    """The state of the planner."""

    interval_seconds: Annotated[Period, doc("Seconds between two messages, at least.")] = 0.5


class LocalPlan(Sampled, frozen=True, kw_only=True):
    """The next steps of the planner."""

    enabled: Annotated[bool, doc("Publish it.")] = False
    interval_seconds: Annotated[Period, doc("Seconds between two messages, at least.")] = 1.0
    max_points: Annotated[int, Meta(ge=2, le=1000), doc("Points of it that are sent.")] = 40


class GlobalPlan(LocalPlan, frozen=True, kw_only=True):
    """The whole route of the planner."""

    max_points: Annotated[int, Meta(ge=2, le=1000), doc("Points of it that are sent.")] = 60


class DiagnosticsMetric(Sampled, frozen=True, kw_only=True):
    """Diagnostics of the base."""

    interval_seconds: Annotated[Period, doc("Seconds between two messages, at least.")] = 1.0
    max_items: Annotated[int, Meta(ge=1, le=100), doc("Parts of the base that are told, the unhealthy ones first.")] = 8


class LevelMetric(Metric, frozen=True, kw_only=True):
    """The battery, as a value of the diagnostics."""

    status_name: Annotated[str, doc("The name of the diagnostics entry.")] = "/Jackal Base/General/Battery"
    key: Annotated[str, doc("Its value; with (V) or (%) it has that unit.")] = "Battery Voltage (V)"


class StatusOfCharger(Metric, frozen=True, kw_only=True):
    """The entry of the diagnostics that says whether the robot charges."""

    enabled: Annotated[bool, doc("Publish it.")] = False
    status_name: Annotated[str, doc("The name of the diagnostics entry.")] = ""
    key: Annotated[str, doc("The key in that entry.")] = ""
    truthy_values: Annotated[tuple[str, ...], doc("These mean that it charges.")] = ("true", "charging", "yes", "1")
    falsey_values: Annotated[tuple[str, ...], doc("These mean that it does not.")] = (
        "false", "not charging", "no", "0",
    )  # fmt: skip


class Metrics(Section, frozen=True, kw_only=True):
    """The published values of the base."""

    wheel_odometry: Annotated[Sampled, doc("Position by its odometry, in millimetres.")] = Sampled()
    localization_pose: Annotated[Sampled, doc("The same in metres, with its frame.")] = Sampled()
    navigation_status: Annotated[StatusMetric, doc("What the planner does.")] = StatusMetric()
    navigation_goal: Annotated[Metric, doc("Where the planner goes.")] = Metric()
    navigation_local_plan: Annotated[LocalPlan, doc("Its next steps.")] = LocalPlan()
    navigation_global_plan: Annotated[GlobalPlan, doc("Its whole route.")] = GlobalPlan()
    diagnostics: Annotated[DiagnosticsMetric, doc("Its health.")] = DiagnosticsMetric()
    charging_level: Annotated[LevelMetric, doc("Its battery.")] = LevelMetric()
    charging_status: Annotated[StatusOfCharger, doc("Its charger.")] = StatusOfCharger()


class Ros1(ServiceSection, frozen=True, kw_only=True):
    """Drives a base with ROS 1 and reads its telemetry."""

    retired: ClassVar = {"topics": "they are those of the contract", "heartbeat": "mqtt_bridge sends it"}

    drive: Annotated[Driving, doc("Driving.")] = Driving()
    ros: Annotated[Ros, doc("Node and topics.")] = Ros()
    motion: Annotated[Motion, doc("Speeds.")] = Motion()
    safety: Annotated[Safety, doc("When to stop.")] = Safety()
    telemetry: Annotated[Metrics, doc("What is published.")] = Metrics()

    @property
    def drives(self) -> bool:
        return self.enabled and self.drive.enabled

    def master(self) -> str:
        """Return the address of the master."""
        return self.ros.master_uri or os.environ.get("ROS_MASTER_URI") or "http://127.0.0.1:11311"

    def host(self) -> str:
        """Return the address at which the node listens, and to which it lets other nodes connect."""
        return self.ros.host or os.environ.get("ROS_IP") or os.environ.get("ROS_HOSTNAME") or "127.0.0.1"


def _check(reader: Reader, section: Ros1, path: Path) -> Ros1:
    """Note a lock on the topic of commands, and what lets other machines drive the base."""
    if not section.enabled:
        return section
    notes, ros = reader.notes, section.ros
    if section.drives and ros.estop_topic == ros.cmd_vel_topic:
        why = "is cmd_vel_topic, too: write the lock of the multiplexer, or none"
        notes.problem((*path, "ros", "estop_topic"), why)
    if ros.master_uri and not is_loopback(urlsplit(ros.master_uri).hostname or ""):
        why = "is another machine, and ROS has no passwords: whoever reaches it drives this base"
        notes.warning((*path, "ros", "master_uri"), why)
        if not ros.host:
            why = "is missing: nodes on other machines reach this one only by the address that it names"
            notes.warning((*path, "ros", "host"), why)
    elif ros.host and not is_loopback(ros.host):
        why = "is open to other machines, and ROS has no passwords: whoever reaches it drives this base"
        notes.warning((*path, "ros", "host"), why)
    return section


RULES: tuple[Rule, ...] = ((Ros1, _check),)


def programs(config: Config) -> list[Program]:
    """Return the bridge's program; none if disabled. One that does not drive, no motor owner, is ``ros1_reader``."""
    section = config.section(Ros1)
    if not section.enabled:
        return []
    name, service = ("ros1_bridge", "Ros1Bridge") if section.drives else ("ros1_reader", "Ros1Reader")
    return [Program(name, f"pebble.services.ros1_bridge.service:{service}", stage=Stage.DEVICE)]


def offers(config: Config, value: CapabilitiesValue) -> CapabilitiesValue:
    """Return the capabilities with the telemetry of the ROS base that this bridge publishes."""
    section = config.section(Ros1)
    if not section.enabled:
        return value
    offer = TelemetryOffer() if value.telemetry is UNSET else value.telemetry
    metrics = section.telemetry
    charges = offer.charging_status or metrics.charging_status.enabled
    odometry = offer.wheel_odometry or metrics.wheel_odometry.enabled
    return replace(value, telemetry=replace(offer, charging_status=charges, wheel_odometry=odometry))


def facts(config: Config) -> Facts:
    """Return the line of the summary about the base."""
    section = config.section(Ros1)
    if not section.enabled:
        return Facts()
    return Facts((("ros 1", " · ".join(_facts(section))),))


def _facts(section: Ros1) -> Iterator[str]:
    """Yield the parts of the summary's line: node, what it drives, and what keeps other programs out after a stop."""
    yield f"node {section.ros.node_name} at {section.master()}"
    if not section.drives:
        yield "reads only"
        return
    yield f"drives {section.ros.cmd_vel_topic} at {section.motion.max_linear_speed_mps:g} m/s"
    if section.ros.estop_topic == NONE:
        yield "no lock: other programs of ROS drive it while it is stopped"
    else:
        yield f"a stop locks {section.ros.estop_topic}"
