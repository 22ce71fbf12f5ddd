"""The settings and dependencies of three scripts of the original Pebble, whose configs do not list them.

Its names, options, defaults and limits, except `log_file` (a command must not choose a file to write), and the size of
pictures, which is the camera's.
"""

from typing import Any

from msgspec.structs import replace

from pebble.config.media import CameraCapture
from pebble.services.autonomy_manager.forms import Setting


def _s(
    key: str, label: str, type_: Any, default: Any, arg: str, min_: Any = None, max_: Any = None, **more: Any
) -> Setting:
    return Setting(key=key, label=label, type=type_, default=default, arg=arg, min=min_, max=max_, **more)


_PREVIEW = _s("preview", "Preview Window", "bool", False, "--preview", mode="flag")

_ODOMETRY = (
    _s("use_tune_state", "Use Tune State", "bool", False, "--use-tune-state", mode="flag",
       arg_false="--no-use-tune-state"),
)  # fmt: skip

#: Their default is the camera's: pictures of another size run on into one another, and tags are misplaced.
_LOCATIONS = (
    _s("width", "Frame Width", "int", None, "--width", 160),
    _s("height", "Frame Height", "int", None, "--height", 120),
    _s("fps", "Frame FPS", "float", None, "--fps", 1.0),
    _s("control_rate_hz", "Publish Rate (Hz)", "float", 12.0, "--rate", 1.0),
    _s("marker_dictionary", "Tag Dictionary", "string", "APRILTAG_25H9", "--marker-dictionary"),
    _s("locations_topic", "Locations Topic", "string", "", "--locations-topic"),
    _s("overlays_topic", "Overlays Topic", "string", "", "--overlays-topic"),
    _PREVIEW,
)

_ODOM_FOLLOW = (
    _s("tag_id", "Tag ID", "int", 13, "--marker-id", 0),
    _s("tag_size_m", "Tag Size (m)", "float", 0.25, "--marker-size", 0.01, required=True),
    _s("target_distance_m", "Target Distance (m)", "float", 0.6, "--target-distance", 0.05),
    _s("distance_threshold_m", "Distance Threshold (m)", "float", 0.05, "--distance-threshold", 0.0),
    _s("standoff_hysteresis_m", "Standoff Hysteresis (m)", "float", 0.03, "--standoff-hysteresis-m", 0.0),
    _s("vision_forward_kp", "Vision Forward Kp", "float", 2.0, "--vision-forward-kp", 0.0),
    _s("vision_reverse_kp", "Vision Reverse Kp", "float", 2.0, "--vision-reverse-kp", 0.0),
    _s(
        "vision_forward_floor_distance_m",
        "Vision Floor Dist (m)",
        "float",
        0.2,
        "--vision-forward-floor-distance-m",
        0.0,
    ),
    _s("forward_cone_deg", "Forward Cone (deg)", "float", 18.0, "--forward-cone-deg", 5.0, 75.0),
    _s("forward_min_power", "Forward Min Power", "float", 0.8, "--forward-min-power", 0.0, 1.0),
    _s("forward_max_power", "Forward Max Power", "float", 1.0, "--forward-max-power", 0.0, 1.0),
    _s("tags_topic", "Tags Topic", "string", "", "--tags-topic"),
    _s("odom_topic", "Odom Topic", "string", "", "--odom-topic"),
    _s("control_rate_hz", "Control Rate (Hz)", "float", 10.0, "--rate", 1.0),
    _s("turn_power", "Turn Power", "float", 0.5, "--turn-power", 0.05, 1.0),
    _s("turn_pulse_s", "Turn Pulse (s)", "float", 0.08, "--turn-pulse", 0.02),
    _s("turn_cooldown_s", "Turn Cooldown (s)", "float", 0.18, "--turn-cooldown", 0.0),
    _s("odom_goal_tolerance_m", "Odom Goal Tolerance (m)", "float", 0.06, "--odom-goal-tolerance-m", 0.01),
    _s("map_pose_topic", "Map Pose Topic", "string", "", "--map-pose-topic"),
    _s("min_wheel_pwm", "Min Wheel PWM", "float", 0.3, "--min-wheel-pwm", 0.0, 1.0),
    _s("odom_heading_kp", "Odom Heading Kp", "float", 1.5, "--odom-heading-kp", 0.1),
    _s("odom_distance_kp", "Odom Distance Kp", "float", 1.4, "--odom-distance-kp", 0.1),
    _s("odom_min_drive_power", "Odom Min Drive Power", "float", 0.35, "--odom-min-drive-power", 0.0, 1.0),
    _s("odom_max_drive_power", "Odom Max Drive Power", "float", 0.9, "--odom-max-drive-power", 0.0, 1.0),
    _s("odom_brake_distance_m", "Odom Brake Distance (m)", "float", 0.25, "--odom-brake-distance-m", 0.0),
    _s("search_pause_s", "Search Pause (s)", "float", 0.35, "--search-pause", 0.0),
    _s("search_reverse_after_s", "Search Reverse After (s)", "float", 0.0, "--search-reverse-after", 0.0),
    _s("lost_timeout_s", "Lost Timeout (s)", "float", 0.7, "--lost-timeout", 0.0),
    _s("tag_timeout_s", "Tag Timeout (s)", "float", 0.35, "--tag-timeout", 0.05),
    _s("min_goal_advance_m", "Min Goal Advance (m)", "float", 0.1, "--min-goal-advance-m", 0.0),
    _s("goal_hold_s", "Goal Hold (s)", "float", 0.4, "--goal-hold-s", 0.0),
    _PREVIEW,
)

#: By the script's folder; :func:`settings_of` completes them.
SETTINGS: dict[str, tuple[Setting, ...]] = {
    "wheel-odometry": _ODOMETRY,
    "apriltag-locations": _LOCATIONS,
    "apriltag-odom-follow": _ODOM_FOLLOW,
}


def settings_of(name: str, camera: CameraCapture) -> tuple[Setting, ...]:
    """The settings of a script; none for one that is not known."""
    own = {"width": camera.width, "height": camera.height, "fps": float(camera.fps)}
    return tuple(replace(one, default=own.get(one.key, one.default)) for one in SETTINGS.get(name, ()))


#: By the script's folder: the scripts it needs, with their settings.
DEPENDENCIES: dict[str, tuple[tuple[str, dict[str, Any]], ...]] = {
    "apriltag-odom-follow": (
        ("apriltag-locations", {}),
        ("wheel-odometry", {"use_tune_state": False}),
    )
}
