"""The file of a simulated world: room, walls, tags, robots and their camera; read with all mistakes at once.

Lengths are metres, angles degrees, counter-clockwise; x is forward and y left of a robot with heading 0.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from itertools import combinations
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from msgspec import Meta

from pebble.config import problems
from pebble.config.problems import Notes, nearest
from pebble.config.raw import decode, plain, read_text
from pebble.config.reader import Reader
from pebble.config.types import EMPTY, Section, doc
from pebble.contract.identity import LEVEL, LEVEL_RULE
from pebble.errors import ConfigError, DeviceError
from pebble.extensions.lab.simulation.motion import TRACK_MM, WHEEL_DIAMETER_MM

MOST_ROBOTS: Final = 32
LONGEST_NAME: Final = 64  # bytes of a robot's name
LONGEST_LATENCY_MS: Final = 500
LONGEST_EXPOSURE_MS: Final = 200
_valid_level = re.compile(LEVEL).search
_TAGS_OF: Final = {"APRILTAG_16h5": 30, "APRILTAG_25h9": 35, "APRILTAG_36h10": 2320, "APRILTAG_36h11": 587}

Metres = Annotated[float, Meta(ge=-100, le=100)]
Length = Annotated[float, Meta(gt=0, le=10)]
Millimetres = Annotated[float, Meta(ge=10, le=1000)]
Degrees = Annotated[float, Meta(ge=-3600, le=3600)]
TagId = Annotated[int, Meta(ge=0, le=2319)]
Share = Annotated[float, Meta(ge=0, le=1)]
Colour = Annotated[str, Meta(pattern="^#[0-9a-f]{6}$(?!\\n)", extra={"expected": 'a colour such as "#2f7d32"'})]


class Lens(Section, frozen=True, kw_only=True):
    """The camera of every robot: it looks ahead, level, from the middle of the robot."""

    hfov_deg: Annotated[float, Meta(ge=10, le=150, description="Angle from the left edge to the right.")] = 54.3
    height_m: Annotated[float, Meta(gt=0, le=1, description="Of the lens above the floor.")] = 0.12
    blur: Annotated[float, Meta(ge=0, le=20, description="Sigma of the lens's blur, pixels.")] = 0.8
    noise: Annotated[float, Meta(ge=0, le=100, description="Sigma of the sensor's noise, of 255.")] = 4.0
    latency_ms: Annotated[float, Meta(ge=0, le=LONGEST_LATENCY_MS, description="Age of a new picture.")] = 0.0
    motion_blur_ms: Annotated[float, Meta(ge=0, le=LONGEST_EXPOSURE_MS, description="Exposure time.")] = 0.0
    jpeg_quality: Annotated[
        Annotated[int, Meta(ge=1, le=100)] | None, doc("Pictures pass through a JPEG of this quality.")
    ] = None


class Tag(Section, frozen=True, kw_only=True):
    """An AprilTag. The middle of its black square, of ``size_m``, is at x, y, z; its front looks to ``yaw_deg``."""

    id: TagId
    x: Metres
    y: Metres
    z: Annotated[float, Meta(ge=0, le=10)] = 0.2
    yaw_deg: Degrees = 0.0
    size_m: Length = 0.25


class Shape(Section, frozen=True, kw_only=True):
    """A polygon of a drawing; ``points``: x, y, x, y … as shares of the drawing, from its upper left."""

    colour: Colour
    points: tuple[Share, ...]


class Drawing(Section, frozen=True, kw_only=True):
    """A window or a plant.

    Its middle is at x, y, z, its front looks to ``yaw_deg``; later shapes cover earlier ones.
    """

    x: Metres
    y: Metres
    z: Annotated[float, Meta(ge=0, le=10)]
    yaw_deg: Degrees = 0.0
    width_m: Length
    height_m: Length
    shapes: tuple[Shape, ...]


class Start(Section, frozen=True, kw_only=True):
    """A robot at its start: a round body, drawn as a box with ``tag`` on all four sides."""

    kind: Literal["goob", "fred"] = "goob"
    x: Metres
    y: Metres
    heading_deg: Degrees = 0.0
    radius_m: Annotated[float, Meta(ge=0.02, le=2)] = 0.1
    tag: TagId | None = None
    imu: Annotated[bool, doc("With the second board of a Goob, its inertial sensor.")] = False
    left_wheel_mm: Millimetres = WHEEL_DIAMETER_MM
    right_wheel_mm: Millimetres = WHEEL_DIAMETER_MM
    track_mm: Millimetres = TRACK_MM


class Room(Section, frozen=True, kw_only=True):
    """A rectangle of walls."""

    x_min: Metres
    x_max: Metres
    y_min: Metres
    y_max: Metres
    height_m: Length = 0.6

    @property
    def walls(self) -> tuple[Wall, ...]:
        """The four walls, counter-clockwise: their left sides face into the room."""
        corners = (
            (self.x_min, self.y_min),
            (self.x_max, self.y_min),
            (self.x_max, self.y_max),
            (self.x_min, self.y_max),
        )
        return tuple(
            Wall(x1=x1, y1=y1, x2=x2, y2=y2, height_m=self.height_m)
            for (x1, y1), (x2, y2) in zip(corners, (*corners[1:], corners[0]), strict=True)
        )

    def holds(self, x: float, y: float) -> bool:
        return self.x_min < x < self.x_max and self.y_min < y < self.y_max


class Wall(Section, frozen=True, kw_only=True):
    """A thin wall from x1, y1 to x2, y2."""

    x1: Metres
    y1: Metres
    x2: Metres
    y2: Metres
    height_m: Length = 0.6
    colour: Annotated[Colour | None, doc("Without one it is light.")] = None

    def distance(self, x: float, y: float) -> float:
        """Return the distance from a point to the nearest point of the wall."""
        along_x, along_y = self.x2 - self.x1, self.y2 - self.y1
        part = ((x - self.x1) * along_x + (y - self.y1) * along_y) / (along_x**2 + along_y**2)
        part = min(1.0, max(0.0, part))
        return math.hypot(x - self.x1 - part * along_x, y - self.y1 - part * along_y)


class World(Section, frozen=True, kw_only=True):
    """A world. Without a room its floor is endless."""

    family: Literal["APRILTAG_16h5", "APRILTAG_25h9", "APRILTAG_36h10", "APRILTAG_36h11"] = "APRILTAG_25h9"
    camera: Lens = Lens()
    tags: tuple[Tag, ...] = ()
    robots: Annotated[dict[str, Start], doc("By their names.")] = EMPTY
    room: Room | None = None
    walls: tuple[Wall, ...] = ()
    drawings: Annotated[tuple[Drawing, ...], doc("Nothing stops at them.")] = ()

    @property
    def all_walls(self) -> tuple[Wall, ...]:
        """All walls: the room's, and those inside it."""
        return (*(self.room.walls if self.room else ()), *self.walls)


def read_world(path: Path) -> World:
    """Return the world in a file. Raises ConfigError with every mistake, each with the file and its place."""
    raw = decode(read_text(path), str(path))
    try:
        return parse_world(raw)
    except ConfigError as error:
        raise ConfigError([f"{path}: {problem}" for problem in error.problems]) from None


def parse_world(raw: Any) -> World:
    """Return a world from parsed JSON. Raises ConfigError with every mistake."""
    reader = Reader(Path(), {}, ())
    world = reader.section(World, plain(raw, reader.notes))
    if not reader.notes.problems:
        _check(world, reader.notes)
    if reader.notes.problems:
        raise ConfigError(list(dict.fromkeys(map(str, reader.notes.problems))))
    return world


def split_device(device: str) -> tuple[Path, str]:
    """Return the world file and the robot that ``world.json#goob`` names. Raises DeviceError."""
    path, _, robot = device.rpartition("#")
    if not path or not robot:
        raise DeviceError(f"{device!r} is no robot of a world, write for example /path/world.json#goob")
    return Path(path).expanduser().absolute(), robot


def open_world(path: Path, robot: str) -> World:
    """Return the world of this file, in which the robot must be. Raises DeviceError with one line."""
    try:
        world = read_world(path)
    except ConfigError as error:
        first, *more = error.problems
        raise DeviceError(first + (f" (and {len(more)} more)" if more else "")) from None
    if robot not in world.robots:
        raise DeviceError(f"{path}: there is no robot {robot!r}, {nearest(robot, world.robots)}")
    return world


def _check(world: World, notes: Notes) -> None:
    """Note contradictions in a world whose values are valid one by one."""
    for index, wall in enumerate(world.walls):
        if (wall.x1, wall.y1) == (wall.x2, wall.y2):
            notes.problem(("walls", index), "begins where it ends")
    for index, drawing in enumerate(world.drawings):
        if not drawing.shapes or any(len(shape.points) < 6 or len(shape.points) % 2 for shape in drawing.shapes):
            notes.problem(("drawings", index), "needs shapes of three points or more, each x and y")
    if (room := world.room) is not None:
        for axis, low, high in (("x", room.x_min, room.x_max), ("y", room.y_min, room.y_max)):
            if low >= high:
                notes.problem(("room", f"{axis}_min"), f"must be below {axis}_max, which is {high:g}, not {low:g}")
    _check_tags(world, notes)
    _check_robots(world.robots, notes)
    if not notes.problems:
        _check_places(world, notes)


def _check_tags(world: World, notes: Notes) -> None:
    count = _TAGS_OF[world.family]
    ids: list[tuple[problems.Path, int]] = [(("tags", index, "id"), tag.id) for index, tag in enumerate(world.tags)]
    ids += [(("robots", name, "tag"), place.tag) for name, place in world.robots.items() if place.tag is not None]
    for path, number in ids:
        if number >= count:
            notes.problem(path, f"must be below {count}, the number of tags in {world.family}, not {number}")


def _check_robots(robots: Mapping[str, Start], notes: Notes) -> None:
    if not 1 <= len(robots) <= MOST_ROBOTS:
        notes.problem(("robots",), f"must be 1 to {MOST_ROBOTS} robots, not {len(robots)}")
    for name in robots:
        if not _valid_level(name) or len(name.encode()) > LONGEST_NAME:
            notes.problem(("robots", name), f"the name must be {LEVEL_RULE}, at most {LONGEST_NAME} bytes")
    for name, place in robots.items():
        if place.imu and place.kind != "goob":
            notes.problem(("robots", name, "imu"), f"must be false, a {place.kind} has no inertial sensor")
    for (name, start), (other_name, other_start) in combinations(robots.items(), 2):
        apart = math.hypot(start.x - other_start.x, start.y - other_start.y)
        least = start.radius_m + other_start.radius_m
        if apart < least:
            notes.problem(("robots", other_name), f"stands {apart:.2f} m from {name}, must be {least:g} m or more")


def _check_places(world: World, notes: Notes) -> None:
    """Note robots that stand outside the room or in a wall."""
    for name, place in world.robots.items():
        if world.room is not None and not world.room.holds(place.x, place.y):
            notes.problem(("robots", name), f"stands outside the room, at {place.x:g}, {place.y:g}")
            continue
        nearest_wall = min((wall.distance(place.x, place.y) for wall in world.all_walls), default=math.inf)
        if nearest_wall < place.radius_m:
            notes.problem(
                ("robots", name), f"stands {nearest_wall:.2f} m from a wall, its radius is {place.radius_m:g}"
            )
