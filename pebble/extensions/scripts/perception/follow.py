"""A controller that drives towards a tag and holds a distance from it, by the camera alone.

A tag outside of a cone ahead is turned to in pulses with pauses between them, because a turning camera sees a blurred
picture, and a late one. Inside the cone the robot drives and steers. A lost tag is waited for, then searched in the
direction in which it was last seen. The settings are the original's, by its names.
"""

import math
from typing import Annotated, NamedTuple

from msgspec import Meta, Struct

from pebble.extensions.scripts.perception.tags import Place

_STEER_PER_RAD = 0.35  # while driving: 2 rad/s per rad on Goob, stable with pictures that are 200 ms late
_TURN_PER_RAD = 1.2  # the power of a pulse
_LEAST_TURN = 0.12
_ALIGNED_RAD = 0.08  # at the wanted distance, a smaller angle is not turned to
_LEAST_DRIVE = 0.08
_ARRIVED = 0.4  # holding begins within this share of the threshold, and ends beyond threshold and hysteresis
_REVERSE_POWER = 0.8
_NEAR_M = 0.1  # beyond the wanted distance: a tag that is lost here has grown out of the picture
_AWAY_S, _AWAY_POWER = 0.6, 0.15  # then the robot backs away

Power = Annotated[float, Meta(ge=0, le=1)]
Gain = Annotated[float, Meta(ge=0)]
Length = Annotated[float, Meta(ge=0)]


class FollowSettings(Struct, frozen=True, kw_only=True):
    """The settings of a script that follows a tag, also by odometry: distances in m, times in s, powers 0..1."""

    tag_id: Annotated[int, Meta(ge=0, title="Tag ID", extra={"arg": "marker-id"})] = 13
    tag_size_m: Annotated[
        float, Meta(ge=0.01, title="Tag Size (m)", extra={"arg": "marker-size", "required": True})
    ] = 0.25
    target_distance_m: Annotated[
        float, Meta(ge=0.05, title="Target Distance (m)", extra={"arg": "target-distance"})
    ] = 0.6
    distance_threshold_m: Annotated[
        Length, Meta(title="Distance Threshold (m)", extra={"arg": "distance-threshold"})
    ] = 0.05
    standoff_hysteresis_m: Annotated[Length, Meta(title="Standoff Hysteresis (m)")] = 0.03
    vision_forward_kp: Annotated[Gain, Meta(title="Vision Forward Kp")] = 2.0
    vision_reverse_kp: Annotated[Gain, Meta(title="Vision Reverse Kp")] = 2.0
    #: Beyond the threshold and this, at least the minimum power.
    vision_forward_floor_distance_m: Annotated[Length, Meta(title="Vision Floor Dist (m)")] = 0.2
    forward_cone_deg: Annotated[float, Meta(ge=5, le=75, title="Forward Cone (deg)")] = 18.0
    forward_min_power: Annotated[Power, Meta(title="Forward Min Power")] = 0.8
    forward_max_power: Annotated[Power, Meta(title="Forward Max Power")] = 1.0
    control_rate_hz: Annotated[float, Meta(ge=1, title="Control Rate (Hz)", extra={"arg": "rate"})] = 10.0
    turn_power: Annotated[float, Meta(ge=0.05, le=1, title="Turn Power")] = 0.5
    turn_pulse_s: Annotated[float, Meta(ge=0.02, title="Turn Pulse (s)", extra={"arg": "turn-pulse"})] = 0.08
    turn_cooldown_s: Annotated[float, Meta(ge=0, title="Turn Cooldown (s)", extra={"arg": "turn-cooldown"})] = 0.18
    odom_goal_tolerance_m: Annotated[float, Meta(ge=0.01, title="Odom Goal Tolerance (m)")] = 0.06
    odom_heading_kp: Annotated[float, Meta(ge=0.1, title="Odom Heading Kp")] = 1.5
    odom_distance_kp: Annotated[float, Meta(ge=0.1, title="Odom Distance Kp")] = 1.4
    odom_min_drive_power: Annotated[Power, Meta(title="Odom Min Drive Power")] = 0.35
    odom_max_drive_power: Annotated[Power, Meta(title="Odom Max Drive Power")] = 0.9
    odom_brake_distance_m: Annotated[Length, Meta(title="Odom Brake Distance (m)")] = 0.25
    search_pause_s: Annotated[float, Meta(ge=0, title="Search Pause (s)", extra={"arg": "search-pause"})] = 0.35
    search_reverse_after_s: Annotated[
        float, Meta(ge=0, title="Search Reverse After (s)", extra={"arg": "search-reverse-after"})
    ] = 0.0
    lost_timeout_s: Annotated[float, Meta(ge=0, title="Lost Timeout (s)", extra={"arg": "lost-timeout"})] = 0.7
    tag_timeout_s: Annotated[float, Meta(ge=0.05, title="Tag Timeout (s)", extra={"arg": "tag-timeout"})] = 0.35
    min_goal_advance_m: Annotated[Length, Meta(title="Min Goal Advance (m)")] = 0.1
    goal_hold_s: Annotated[float, Meta(ge=0, title="Goal Hold (s)")] = 0.4


class Command(NamedTuple):
    """A drive command with its reason."""

    x: float = 0.0
    z: float = 0.0
    reason: str = "hold"


class Pulses:
    """A rhythm of short turns and pauses."""

    def __init__(self) -> None:
        self._x = 0.0
        self._on_until = self._off_until = float("-inf")

    def turn(self, x: float, on_s: float, off_s: float, now: float) -> float:
        """Return the turn to command now: the ``x`` of the pulse while it lasts, then 0.

        ``x`` counts only when a new pulse begins, after the last pulse and its pause.
        """
        if now >= self._off_until:
            self._x = x
            self._on_until = now + on_s
            self._off_until = self._on_until + off_s
        return self._x if now < self._on_until else 0.0


class Follower:
    """A follower of a tag. Call ``step`` at about 10 Hz with the tag's place, None if it is not in the picture."""

    def __init__(self, settings: FollowSettings) -> None:
        self.settings = settings
        self._pulses = Pulses()
        self._seen_at = self._side_since = float("-inf")  # when the tag was last seen; since when ``_side`` is so
        self._side = 1.0  # the side on which the tag was seen last, and to which the search turns: right is positive
        self._last = Command()
        self._holding = False  # the wanted distance is reached
        self._near = False  # the tag was near when it was seen last

    def step(self, now: float, place: Place | None) -> Command:
        self._last = self._without_tag(now) if place is None else self._with_tag(now, place)
        return self._last

    def _with_tag(self, now: float, place: Place) -> Command:
        """Return a command for a visible tag: turn to it if it is outside of the cone, else drive to the distance."""
        self._seen_at = self._side_since = now
        self._near = place.distance_m < self.settings.target_distance_m + _NEAR_M
        self._side = math.copysign(1.0, place.angle_rad)
        if abs(place.angle_rad) > math.radians(self.settings.forward_cone_deg):
            self._holding = False
            return self._turn(now, place.angle_rad)
        too_far_m = place.distance_m - self.settings.target_distance_m
        threshold_m = self.settings.distance_threshold_m
        # It must come nearer to begin holding than to go on holding, so that small errors do not move it to and fro.
        tolerance_m = threshold_m + self.settings.standoff_hysteresis_m if self._holding else _ARRIVED * threshold_m
        self._holding = abs(too_far_m) <= tolerance_m
        if not self._holding:
            return self._approach(too_far_m, place.angle_rad)
        if abs(place.angle_rad) > _ALIGNED_RAD:
            return self._turn(now, place.angle_rad)
        return Command()

    def _turn(self, now: float, angle: float) -> Command:
        settings = self.settings
        power = min(settings.turn_power, max(_LEAST_TURN, _TURN_PER_RAD * abs(angle)))
        x = self._pulses.turn(math.copysign(power, angle), settings.turn_pulse_s, settings.turn_cooldown_s, now)
        return Command(x, 0.0, "turn")

    def _approach(self, too_far_m: float, angle: float) -> Command:
        """Return the command for a tag inside the cone; ``too_far_m`` < 0: it is too near."""
        settings = self.settings
        x = max(-settings.turn_power, min(settings.turn_power, _STEER_PER_RAD * angle))
        if too_far_m < 0.0:
            power = settings.vision_reverse_kp * -too_far_m
            return Command(x, -min(_REVERSE_POWER, max(_LEAST_DRIVE, power)), "back")
        power = settings.vision_forward_kp * too_far_m
        if too_far_m >= settings.distance_threshold_m + settings.vision_forward_floor_distance_m:
            power = max(power, settings.forward_min_power)
        most = min(settings.forward_max_power, 1.0 - abs(x))  # the rest is for steering
        return Command(x, min(most, max(_LEAST_DRIVE, power)), "drive")

    def _without_tag(self, now: float) -> Command:
        """Return the command while the tag is not in the picture: go on, back away, wait, or search for it."""
        settings, gone_s = self.settings, now - self._seen_at
        if gone_s <= settings.tag_timeout_s and self._last.reason in ("drive", "back"):
            return self._last  # it may be missing in a single picture
        self._holding = False
        if self._near and 0.0 < gone_s - settings.tag_timeout_s <= _AWAY_S:
            return Command(0.0, -_AWAY_POWER, "back away")  # it was so near that it has outgrown the picture
        if gone_s <= settings.lost_timeout_s:
            return Command(reason="wait")
        return self._search(now)

    def _search(self, now: float) -> Command:
        """Turn to the side where the tag was seen last, and after ``search_reverse_after_s`` to the other one."""
        settings = self.settings
        reverse_s = settings.search_reverse_after_s
        if reverse_s > 0.0 and now - self._side_since > reverse_s:
            self._side = -self._side
            self._side_since = now
        # A pulse lasts for one or two commands: with more power it could turn the robot past more than its camera sees.
        x = self._pulses.turn(self._side * settings.turn_power, settings.turn_pulse_s, settings.search_pause_s, now)
        return Command(x, 0.0, "search")
