"""The config sections of services that later releases bring: typed and checked now, so that files stay valid."""

from typing import Annotated

from msgspec import Meta

from pebble.config.types import Count, Interval, Qos, Section, ServiceSection, Topic, doc


class RosSwitch(Section, frozen=True, kw_only=True):
    """Whether ROS drives the robot."""

    enabled: Annotated[bool, doc("Send drive commands to ROS.")] = True


class RosTopics(Section, frozen=True, kw_only=True):
    """Other topics for what the ROS bridge publishes and subscribes to; unset: the contract's."""

    drive_values: Annotated[Topic | None, doc("Instead of `{base}/incoming/drive-values`.")] = None
    wheel_odometry: Annotated[Topic | None, doc("Instead of `{base}/outgoing/wheel-odometry`.")] = None
    charging_status: Annotated[Topic | None, doc("Instead of `{base}/outgoing/charging-status`.")] = None
    charging_level: Annotated[Topic | None, doc("Instead of `{base}/outgoing/charging-level`.")] = None
    localization_pose: Annotated[Topic | None, doc("Instead of `{base}/outgoing/localization-pose`.")] = None
    navigation_status: Annotated[Topic | None, doc("Instead of `{base}/outgoing/navigation-status`.")] = None
    navigation_goal: Annotated[Topic | None, doc("Instead of `{base}/outgoing/navigation-goal`.")] = None
    navigation_local_plan: Annotated[Topic | None, doc("Instead of `{base}/outgoing/navigation/local-plan`.")] = None
    navigation_global_plan: Annotated[Topic | None, doc("Instead of `{base}/outgoing/navigation/global-plan`.")] = None
    diagnostics: Annotated[Topic | None, doc("Instead of `{base}/outgoing/diagnostics`.")] = None


class RosHeartbeat(Section, frozen=True, kw_only=True):
    """Sign of life of the ROS side."""

    enabled: Annotated[bool, doc("Send it.")] = True
    topic: Annotated[Topic | None, doc("Instead of `{base}/outgoing/online`.")] = None
    interval_seconds: Annotated[float, Meta(ge=0.05, le=3600, description="Seconds between two of them.")] = 0.25
    qos: Annotated[Qos | None, doc("Instead of the contract's QoS.")] = None
    retain: Annotated[bool | None, doc("Instead of the contract's retain flag.")] = None


class RosNames(Section, frozen=True, kw_only=True):
    """Names on the ROS side."""

    node_name: Annotated[str, doc("ROS node.")] = "pebble_ros1_bridge"
    cmd_vel_topic: Annotated[str, doc("ROS topic of drive commands.")] = "/cmd_vel"
    cmd_vel_publish_interval_seconds: Annotated[Interval, doc("How often a drive command is repeated.")] = 0.05
    odometry_topic: Annotated[str, doc("ROS topic.")] = "/odometry/filtered"
    navigation_status_topic: Annotated[str, doc("ROS topic.")] = "/move_base/status"
    navigation_goal_topic: Annotated[str, doc("ROS topic.")] = "/move_base/current_goal"
    navigation_local_plan_topic: Annotated[str, doc("ROS topic.")] = "/move_base/TrajectoryPlannerROS/local_plan"
    navigation_global_plan_topic: Annotated[str, doc("ROS topic.")] = "/move_base/NavfnROS/plan"
    diagnostics_topic: Annotated[str, doc("ROS topic.")] = "/diagnostics_agg"


class RosMotion(Section, frozen=True, kw_only=True):
    """The speeds of a drive value of 1."""

    max_linear_speed_mps: Annotated[float, Meta(gt=0, le=100, description="Metres per second.")] = 0.6
    max_angular_speed_radps: Annotated[float, Meta(gt=0, le=100, description="Radians per second.")] = 1.2


class RosItem(Section, frozen=True, kw_only=True):
    """One report from ROS; QoS, retain and limits unset: the bridge's defaults."""

    enabled: Annotated[bool | None, doc("Publish it; unset: all but the two plans and charging_status.")] = None
    interval_seconds: Annotated[Interval | None, doc("Seconds between two of them.")] = None
    qos: Annotated[Qos | None, doc("QoS.")] = None
    retain: Annotated[bool | None, doc("Retain flag.")] = None
    max_points: Annotated[Count | None, doc("Points of a plan that are sent.")] = None
    max_items: Annotated[Count | None, doc("Lines of diagnostics that are sent.")] = None
    status_name: Annotated[str | None, doc("Entry of the diagnostics to read.")] = None
    key: Annotated[str | None, doc("Key of that entry to read.")] = None
    truthy_values: Annotated[tuple[str, ...], doc("Texts that mean yes.")] = ()
    falsey_values: Annotated[tuple[str, ...], doc("Texts that mean no.")] = ()


class RosTelemetry(Section, frozen=True, kw_only=True):
    """What the ROS bridge reports."""

    wheel_odometry: Annotated[RosItem, doc("Wheel odometry.")] = RosItem()
    localization_pose: Annotated[RosItem, doc("Pose.")] = RosItem()
    navigation_status: Annotated[RosItem, doc("Navigation.")] = RosItem()
    navigation_goal: Annotated[RosItem, doc("Goal.")] = RosItem()
    navigation_local_plan: Annotated[RosItem, doc("Local plan.")] = RosItem()
    navigation_global_plan: Annotated[RosItem, doc("Global plan.")] = RosItem()
    diagnostics: Annotated[RosItem, doc("Diagnostics.")] = RosItem()
    charging_level: Annotated[RosItem, doc("Battery.")] = RosItem()
    charging_status: Annotated[RosItem, doc("Charging.")] = RosItem()


class RosSafety(Section, frozen=True, kw_only=True):
    """When ROS is stopped."""

    drive_timeout_seconds: Annotated[float, Meta(gt=0, le=5, description="No drive command for this long: stop.")] = (
        0.75
    )
    ignore_retained_drive: Annotated[bool, doc("Refuse a retained drive command, because it is stale.")] = True
    stop_on_shutdown: Annotated[bool, doc("Send a stop at the end.")] = True


class Ros1Bridge(ServiceSection, frozen=True, kw_only=True):
    """The connection to a ROS 1 robot."""

    drive: Annotated[RosSwitch, doc("Driving.")] = RosSwitch()
    topics: Annotated[RosTopics, doc("Other names for topics.")] = RosTopics()
    heartbeat: Annotated[RosHeartbeat, doc("Sign of life.")] = RosHeartbeat()
    ros: Annotated[RosNames, doc("Names on the ROS side.")] = RosNames()
    motion: Annotated[RosMotion, doc("Speeds.")] = RosMotion()
    telemetry: Annotated[RosTelemetry, doc("Reports.")] = RosTelemetry()
    safety: Annotated[RosSafety, doc("When to stop.")] = RosSafety()
