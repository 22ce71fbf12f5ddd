"""Draws the pictures of a robot's camera in a simulated world.

All surfaces are upright and the camera is level, so a plan, seen from above, shows which surface hides which.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from pebble.extensions.lab.simulation.world.poses import RobotPose, Track
from pebble.extensions.lab.simulation.world.surfaces import Image, Surface, Surfaces
from pebble.extensions.lab.simulation.world.world_file import Room, World
from pebble.extensions.media.scene import noise

_NEAR_M: Final = 0.05  # nothing nearer is drawn
_BESIDE_PX = 64.0  # beyond the picture's edges surfaces are cut off
_TOUCHING_M = 1e-4  # surfaces as near to each other lie in one plane
_EXPOSURES = 4  # pictures whose mean shows motion blur
_SKY, _GROUND = (214, 208, 200), (112, 118, 122)
_FLOOR_PX, _TILE_M = 512, 0.25
_NOISES = 61  # how far the noise is shifted between pictures, at most; in both directions
_SHIFT = 4  # fractional bits of a corner

_Floats: TypeAlias = NDArray[np.float64]


class Renderer:
    """Pictures of ``width`` x ``height``, BGR, of the robot ``me``. The same calls give the same pixels."""

    def __init__(self, world: World, me: str, width: int, height: int) -> None:
        import cv2  # 16 MB, only where pictures are made

        cv2.setNumThreads(1)
        self._cv2: Any = cv2
        self._lens, self._me = world.camera, me
        self._surfaces = Surfaces(world)
        self._width, self._height = width, height
        self._focal = width / 2 / math.tan(math.radians(world.camera.hfov_deg / 2))
        self._middle = ((width - 1) / 2, (height - 1) / 2)
        self._horizon = math.floor(self._middle[1]) + 1  # the first row of the ground
        self._floor, self._floor_to_world = _floor(world)
        self._background = np.full((height, width, 3), _SKY, np.uint8)
        self._background[self._horizon :] = _GROUND
        self._noise = _noise(width, height, world.camera.noise) if world.camera.noise else None
        self._count = 0  # of rendered pictures: each has another part of the noise

    def render(self, tracks: Mapping[str, Track], ns: int, out: Image) -> None:
        """Draw the camera's picture at ``ns`` into ``out``, of shape (height, width, 3), with the camera's faults."""
        cv2, lens = self._cv2, self._lens
        self._expose(tracks, ns, out)
        if lens.blur:
            size = 2 * math.ceil(2 * lens.blur) + 1
            cv2.GaussianBlur(out, (size, size), lens.blur, dst=out)
        if self._noise is not None:
            down, right = self._count * 17 % _NOISES, self._count * 29 % _NOISES  # another part in each picture
            lighter, darker = self._noise[:, down : down + self._height, right : right + self._width]
            cv2.add(out, lighter, dst=out)
            cv2.subtract(out, darker, dst=out)
        if lens.jpeg_quality is not None:
            _, data = cv2.imencode(".jpg", out, (cv2.IMWRITE_JPEG_QUALITY, lens.jpeg_quality))
            out[:] = cv2.imdecode(data, cv2.IMREAD_COLOR)
        self._count += 1

    def _expose(self, tracks: Mapping[str, Track], ns: int, out: Image) -> None:
        """Draw the average of the scene during the exposure, which ends at ``ns``."""
        exposure_ns = self._lens.motion_blur_ms * 1e6
        count = _EXPOSURES if exposure_ns else 1
        times = [ns - round(exposure_ns * number / (_EXPOSURES - 1)) for number in range(count)]
        views = [{name: track.at(moment) for name, track in tracks.items()} for moment in times]
        if all(view == views[0] for view in views):
            self.draw(views[0], out)
            return
        total = np.zeros(out.shape, np.uint16)
        for view in views:
            self.draw(view, out)
            total += out
        out[:] = total // len(views)

    def draw(self, poses: Mapping[str, RobotPose], out: Image) -> None:
        """Draw one moment into ``out``, sharp and without noise."""
        me = poses[self._me]
        np.copyto(out, self._background)
        self._draw_floor(me, out)
        surfaces = self._surfaces.surfaces(poses, self._me)
        if not surfaces:
            return
        plan, numbers = self._seen(surfaces, me)
        seen = [surfaces[number] for number in numbers]  # the surface of each part in the plan
        for index in _back_to_front(plan, [surface.layer for surface in seen], self._columns(plan)):
            surface = seen[index]
            if surface.textures:
                self._draw_texture(surface, me, plan[index], out)
            else:
                self._fill(surface, plan[index], out)

    # -- plan: (n, 2, 2) left and right edge of each surface, as distance ahead of the camera and to its right

    def _seen(self, surfaces: Sequence[Surface], me: RobotPose) -> tuple[_Floats, list[int]]:
        """Return the parts of surfaces that are in front of the camera, each with the index of its surface."""
        edges = np.array([(surface.left, surface.right) for surface in surfaces])
        plan = self._to_camera(edges, me)
        (ahead1, right1), (ahead2, right2) = plan[:, 0].T, plan[:, 1].T
        shows_front = right2 * ahead1 - right1 * ahead2 > 0  # its left edge is seen to the left of its right one
        slope = (self._width / 2 + _BESIDE_PX) / self._focal
        share_from, share_to = np.zeros(len(plan)), np.ones(len(plan))
        # The near plane, then the right and the left edge of the view. Each cuts a surface to the share (0 to 1 of its
        # length) that is visible. The distances are those of the surface's two ends, positive on the visible side.
        for distance1, distance2 in (
            (ahead1 - _NEAR_M, ahead2 - _NEAR_M),
            (slope * ahead1 - right1, slope * ahead2 - right2),
            (slope * ahead1 + right1, slope * ahead2 + right2),
        ):
            # the share at which a surface with its ends on two sides crosses; 0 (unused) if it is parallel
            crossing = distance1 / np.where(distance1 == distance2, np.inf, distance1 - distance2)
            # A surface that is outside as a whole enters at its end, and leaves at its start: nothing is between.
            enters = np.where(distance1 < 0, np.where(distance2 > 0, crossing, 1.0), 0.0)
            leaves = np.where(distance2 < 0, np.where(distance1 > 0, crossing, 0.0), 1.0)
            share_from, share_to = np.maximum(share_from, enters), np.minimum(share_to, leaves)
        shown = np.flatnonzero(shows_front & (share_from < share_to))
        start, along = plan[shown, 0], plan[shown, 1] - plan[shown, 0]
        cut = np.stack((start + along * share_from[shown, None], start + along * share_to[shown, None]), axis=1)
        return cut, shown.tolist()

    def _to_camera(self, points: _Floats, me: RobotPose) -> _Floats:
        sine, cosine = math.sin(me.heading), math.cos(me.heading)
        return np.asarray((points - (me.x, me.y)) @ np.array([[cosine, sine], [sine, -cosine]]))

    def _columns(self, plan: _Floats) -> _Floats:
        """Return the columns in the picture of the edges in the plan."""
        return np.asarray(self._middle[0] + self._focal * plan[..., 1] / plan[..., 0])

    def _rows(self, surface: Surface, plan: _Floats) -> _Floats:
        """Return the picture's rows of the surface's top and bottom: a pair for its left edge, one for its right."""
        heights = self._lens.height_m - np.array((surface.top, surface.bottom))
        return np.asarray(self._middle[1] + self._focal * heights[None] / plan[:, :1])

    # -- drawing

    def _fill(self, surface: Surface, plan: _Floats, out: Image) -> None:
        (left, right), ((top1, bottom1), (top2, bottom2)) = self._columns(plan), self._rows(surface, plan)
        corners = np.array([(left, top1), (right, top2), (right, bottom2), (left, bottom1)])
        points = np.round(corners * (1 << _SHIFT)).astype(np.int32)
        self._cv2.fillConvexPoly(out, points, surface.colour, self._cv2.LINE_AA, _SHIFT)

    def _draw_texture(self, surface: Surface, me: RobotPose, plan: _Floats, out: Image) -> None:
        """Draw a surface with its texture; ``plan``: the edges of its visible part, by :meth:`_seen`.

        Where its mask is not opaque, ``out`` keeps what is behind the surface.
        """
        columns, rows = self._columns(plan), self._rows(surface, plan)  # of each edge: its column, its two rows
        x0, x1 = max(0, math.floor(columns[0])), min(self._width, math.ceil(columns[1]) + 1)
        y0, y1 = max(0, math.floor(rows.min())), min(self._height, math.ceil(rows.max()) + 1)
        if x0 >= x1 or y0 >= y1:
            return
        area = (columns[1] - columns[0]) * (rows[:, 1] - rows[:, 0]).mean()
        whole_width = math.dist(surface.left, surface.right)
        area *= whole_width / max(1e-9, math.dist(plan[0], plan[1]))  # of the whole surface, also beside the picture
        pixels = [len(texture) ** 2 for texture in surface.textures]  # falling
        large_enough = [level for level, count in enumerate(pixels) if count >= area]
        level = large_enough[-1] if large_enough else 0  # the smallest that is not enlarged
        size = len(surface.textures[level])
        (ahead1, right1), (ahead2, right2) = self._to_camera(np.array((surface.left, surface.right)), me)
        to_space = np.array(  # from pixels of the texture to (right, down, ahead) of the camera
            [
                [(right2 - right1) / size, 0.0, right1],
                [0.0, (surface.top - surface.bottom) / size, self._lens.height_m - surface.top],
                [(ahead2 - ahead1) / size, 0.0, ahead1],
            ]
        )
        box = (x0, y0, x1, y1)
        if not surface.masks:
            self._warp(surface.textures[level], to_space, box, out)
            return
        drawn, mask = out.copy(), np.zeros(out.shape[:2], np.uint8)
        self._warp(surface.textures[level], to_space, box, drawn)
        self._warp(surface.masks[level], to_space, box, mask)
        part = np.s_[y0:y1, x0:x1]
        np.copyto(out[part], drawn[part], where=mask[part][..., None] > 127)

    def _warp(self, texture: Image, to_space: _Floats, box: tuple[int, int, int, int], out: Image) -> None:
        """Draw a texture into the ``box`` of a picture. ``to_space``: from its pixels to (right, down, ahead)."""
        x0, y0, x1, y1 = box
        lens = np.array(
            [[self._focal, 0.0, self._middle[0] - x0], [0.0, self._focal, self._middle[1] - y0], [0.0, 0.0, 1.0]]
        )
        # The first pixel's middle is at 0 for OpenCV, and at 0.5 for ``to_space``.
        half_pixel = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 0.5], [0.0, 0.0, 1.0]])
        to_picture = lens @ to_space @ half_pixel
        self._cv2.warpPerspective(
            texture,
            to_picture,
            (x1 - x0, y1 - y0),
            dst=out[y0:y1, x0:x1],
            flags=self._cv2.INTER_LINEAR,
            borderMode=self._cv2.BORDER_TRANSPARENT,
        )

    def _draw_floor(self, me: RobotPose, out: Image) -> None:
        sine, cosine, height = math.sin(me.heading), math.cos(me.heading), self._lens.height_m
        to_camera = np.array(  # from (x, y, 1) on the floor to (right, down, ahead) of the camera
            [
                [sine, -cosine, -sine * me.x + cosine * me.y],
                [0.0, 0.0, height],
                [cosine, sine, -cosine * me.x - sine * me.y],
            ]
        )
        box = (0, self._horizon, self._width, self._height)
        self._warp(self._floor, to_camera @ self._floor_to_world, box, out)


def _back_to_front(plan: _Floats, layers: Sequence[int], columns: _Floats) -> list[int]:
    """Return the order in which to draw surfaces. Of crossing surfaces, the farther one is first."""
    covers = _covers(plan, np.array(layers), columns)
    distance = (plan.mean(axis=1) ** 2).sum(axis=1)
    undrawn, order = set(range(len(plan))), []
    while undrawn:
        farthest_first = sorted(undrawn, key=lambda index: -distance[index])
        # those that hide no part of what is still to be drawn; if each hides another one, the farthest
        chosen = [index for index in farthest_first if not covers[index, farthest_first].any()] or farthest_first[:1]
        order += chosen
        undrawn.difference_update(chosen)
    return order


def _covers(plan: _Floats, layers: NDArray[np.int_], columns: _Floats) -> NDArray[np.bool_]:
    """Return a matrix that is true at ``[i, j]`` if surface i hides a part of j. The camera is at 0, 0.

    ``plan``: edges, as in Renderer. ``columns``: the picture's columns of both edges of each surface. Of surfaces in
    one plane that of the higher layer hides the other.
    """
    start, along = plan[:, 0], plan[:, 1] - plan[:, 0]
    normal = np.stack((along[:, 1], -along[:, 0]), axis=1) / np.linalg.norm(along, axis=1, keepdims=True)
    normal *= np.where((start * normal).sum(axis=1, keepdims=True) > 0, -1.0, 1.0)  # towards the camera
    # how far each edge of i is in front of the plane of j, negative behind it: [i, edge, j]
    before = np.einsum("iek,jk->iej", plan, normal) - (start * normal).sum(axis=1)
    most, least = before.max(axis=1), before.min(axis=1)  # of the two edges of i: [i, j], as all that follow
    in_front = (least > -_TOUCHING_M) & (most > _TOUCHING_M)  # i is in front of the plane of j; an edge may touch it
    behind = (most < _TOUCHING_M) & (least < -_TOUCHING_M)  # i is behind the plane of j; an edge may touch it
    one_plane = (np.abs(before) <= _TOUCHING_M).all(axis=1)
    may_cover = in_front | behind.T  # i is in front of the plane of j, or j is behind the plane of i
    # If each may cover the other, neither does.
    covers = (may_cover & ~may_cover.T) | (one_plane & one_plane.T & (layers[:, None] > layers))
    overlap = (columns[:, None, 0] < columns[:, 1]) & (columns[:, 0] < columns[:, None, 1])
    return np.asarray(covers & overlap & ~np.eye(len(plan), dtype=bool))


def _floor(world: World) -> tuple[Image, _Floats]:
    """Return a texture of tiles, and the matrix from its pixels to the floor.

    It covers the room, or 20 m around the origin.
    """
    import cv2

    room = world.room or Room(x_min=-10, x_max=10, y_min=-10, y_max=10)
    width = max(room.x_max - room.x_min, room.y_max - room.y_min)
    tiles = max(2, min(64, round(width / _TILE_M)))
    checkers = np.indices((tiles, tiles)).sum(axis=0) % 2
    # Two shades of grey in turn, and each tile a little lighter by chance.
    shades = 120 + 26 * checkers + 20 * noise(7, tiles * tiles).reshape(tiles, tiles)
    picture = cv2.resize(shades.astype(np.uint8), (_FLOOR_PX, _FLOOR_PX), interpolation=cv2.INTER_NEAREST)
    scale = width / _FLOOR_PX
    to_world = np.array([[scale, 0.0, room.x_min], [0.0, scale, room.y_min], [0.0, 0.0, 1.0]])
    return np.asarray(cv2.cvtColor(picture, cv2.COLOR_GRAY2BGR), np.uint8), to_world


def _noise(width: int, height: int, sigma: float) -> Image:
    """Return Gaussian noise as two images, its positive and its negative part; pictures use different cut-outs."""
    shape = (height + _NOISES, width + _NOISES, 3)
    grain = np.round(np.random.default_rng(2).standard_normal(shape, np.float32) * np.float32(sigma))
    return np.stack((grain.clip(0, 255), (-grain).clip(0, 255))).astype(np.uint8)
