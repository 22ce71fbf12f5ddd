"""The upright surfaces of a world: walls, drawings, tags and robots, as the renderer draws them."""

import math
from collections.abc import Mapping
from itertools import chain
from typing import Any, Final, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from pebble.extensions.lab.simulation.world.poses import RobotPose
from pebble.extensions.lab.simulation.world.world_file import Drawing, Wall, World

MODULE_PX: Final = 32  # of a tag's texture; halves to 1 without a rest
_DRAWING_PX, _SMALLEST_PX = 256, 16  # of a drawing's textures
_SIDE, _TAG_SIDE = 1.6, 1.2  # of a robot's box and of the tag on it, in radii: the box is about as wide as the circle
_ABOVE_LENS_M = 0.04  # a robot's box ends so far above its camera

Image: TypeAlias = NDArray[np.uint8]
Colour: TypeAlias = tuple[int, int, int]  # blue, green, red
_WALL_COLOURS: Final[tuple[Colour, ...]] = ((196, 204, 208), (186, 192, 200), (176, 186, 196), (190, 196, 198))
_BODY_COLOURS: Final[tuple[Colour, ...]] = ((60, 150, 60), (60, 60, 180), (170, 110, 50), (40, 150, 190))


class Surface(NamedTuple):
    """An upright rectangle from ``left`` to ``right``, seen from its front. It has a colour or a texture.

    Of surfaces in the same place, the one with the higher ``layer`` is in front. A texture comes in several sizes, the
    largest first, perhaps with masks of its opaque parts.
    """

    left: tuple[float, float]
    right: tuple[float, float]
    bottom: float
    top: float
    layer: int
    colour: Colour = (0, 0, 0)
    textures: tuple[Image, ...] = ()
    masks: tuple[Image, ...] = ()


class Surfaces:
    """The surfaces that a robot's camera may see."""

    def __init__(self, world: World) -> None:
        self._world = world
        self._modules_across = _modules(world) + 2  # of a tag with its white border
        self._textures: dict[int, tuple[Image, ...]] = {}
        room_walls = world.room.walls if world.room else ()
        self._fixed = [
            *(_left_side(wall, index) for index, wall in enumerate(room_walls)),  # the side that faces into the room
            *chain(*(_both_sides(wall, index) for index, wall in enumerate(world.walls))),
            *map(_drawn, world.drawings),
            *(self._tag(tag.id, tag.size_m, tag.x, tag.y, tag.z, math.radians(tag.yaw_deg)) for tag in world.tags),
        ]

    def surfaces(self, poses: Mapping[str, RobotPose], me: str) -> list[Surface]:
        """Return all surfaces, with robots at these poses, but without the robot ``me``, which does not see itself."""
        surfaces = list(self._fixed)
        for index, name in enumerate(self._world.robots):
            if name != me and name in poses:
                surfaces += self._robot(name, poses[name], _BODY_COLOURS[index % len(_BODY_COLOURS)])
        return surfaces

    def _robot(self, name: str, pose: RobotPose, colour: Colour) -> list[Surface]:
        """Return the four sides of a robot's box, each with its tag if it has one."""
        place = self._world.robots[name]
        half, top = place.radius_m * _SIDE / 2, self._world.camera.height_m + _ABOVE_LENS_M
        surfaces = []
        for quarter, light in enumerate((1.0, 0.8, 0.65, 0.8)):
            yaw = pose.heading + quarter * math.pi / 2
            x, y = pose.x + half * math.cos(yaw), pose.y + half * math.sin(yaw)
            shade = (round(colour[0] * light), round(colour[1] * light), round(colour[2] * light))
            surfaces.append(Surface(*_edges(x, y, half, yaw), 0.0, top, layer=0, colour=shade))
            if place.tag is not None:
                size = min(place.radius_m * _TAG_SIDE, 0.75 * top)
                surfaces.append(self._tag(place.tag, size, x, y, top / 2, yaw))
        return surfaces

    def _tag(self, number: int, size: float, x: float, y: float, z: float, yaw: float) -> Surface:
        if number not in self._textures:
            self._textures[number] = _tag_textures(self._world.family, number)
        half = size / 2 * self._modules_across / (self._modules_across - 2)  # ``size`` is without the white border
        return Surface(*_edges(x, y, half, yaw), z - half, z + half, layer=2, textures=self._textures[number])


def _edges(x: float, y: float, half: float, yaw: float) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the left and right edge of a surface with its middle at x, y and its front towards ``yaw``."""
    right_x, right_y = -math.sin(yaw) * half, math.cos(yaw) * half
    return (x - right_x, y - right_y), (x + right_x, y + right_y)


def _left_side(wall: Wall, index: int) -> Surface:
    colour = _bgr(wall.colour) if wall.colour else _WALL_COLOURS[index % len(_WALL_COLOURS)]
    return Surface((wall.x2, wall.y2), (wall.x1, wall.y1), 0.0, wall.height_m, layer=0, colour=colour)


def _both_sides(wall: Wall, index: int) -> tuple[Surface, Surface]:
    left_side = _left_side(wall, index)
    return left_side, left_side._replace(left=left_side.right, right=left_side.left)


def _bgr(colour: str) -> Colour:
    return int(colour[5:7], 16), int(colour[3:5], 16), int(colour[1:3], 16)


def _drawn(drawing: Drawing) -> Surface:
    """Return the surface of a drawing, whose masks make all but the shapes transparent."""
    import cv2

    # masked parts have a colour, too: in smaller textures it mixes into the edges of the shapes
    picture = np.full((_DRAWING_PX, _DRAWING_PX, 3), _bgr(drawing.shapes[0].colour), np.uint8)
    mask = np.zeros((_DRAWING_PX, _DRAWING_PX), np.uint8)
    for shape in drawing.shapes:
        points = [np.round(np.array(shape.points).reshape(-1, 2) * _DRAWING_PX).astype(np.int32)]
        cv2.fillPoly(picture, points, _bgr(shape.colour))
        cv2.fillPoly(mask, points, 255)
    edges = _edges(drawing.x, drawing.y, drawing.width_m / 2, math.radians(drawing.yaw_deg))
    low, high = drawing.z - drawing.height_m / 2, drawing.z + drawing.height_m / 2
    textures, masks = _halved(picture, _SMALLEST_PX), _halved(mask, _SMALLEST_PX)
    return Surface(*edges, low, high, layer=1, textures=textures, masks=masks)


def _modules(world: World) -> int:
    return int(_dictionary(world.family).markerSize) + 2


def _tag_textures(family: str, number: int) -> tuple[Image, ...]:
    """Return the tag with a white border of one module, in sizes halved down to one pixel per module."""
    import cv2

    dictionary = _dictionary(family)
    modules = dictionary.markerSize + 2
    grey = cv2.aruco.generateImageMarker(dictionary, number, modules * MODULE_PX)
    white = np.pad(np.asarray(grey, np.uint8), MODULE_PX, constant_values=255)
    return _halved(cv2.cvtColor(white, cv2.COLOR_GRAY2BGR), modules + 2)


def _halved(texture: Any, smallest: int) -> tuple[Image, ...]:
    """Return a square texture in sizes halved down to ``smallest``."""
    import cv2

    textures = [texture]
    while len(textures[-1]) > smallest:
        smaller = len(textures[-1]) // 2
        textures.append(cv2.resize(textures[-1], (smaller, smaller), interpolation=cv2.INTER_AREA))
    return tuple(textures)


def _dictionary(family: str) -> Any:
    import cv2

    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{family}"))
