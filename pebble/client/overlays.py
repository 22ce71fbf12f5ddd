"""Shapes and labels that scripts publish to be drawn over a robot's picture, in all forms that viewers accept. Pure."""

from collections.abc import Iterable
from dataclasses import dataclass

import msgspec

from pebble.contract import VIDEO_OVERLAYS, codec
from pebble.errors import PayloadError

STALE_S = 1.0  # overlays come up to 12 times a second
_PAYLOAD_BYTES = 64 * 1024
_SHAPES, _POINTS, _SOURCES = 100, 500, 8  # of a payload, of a shape, of a robot; more are not drawn

Point = tuple[float, float]  # right and down, 0..1 of the picture


@dataclass(frozen=True, slots=True)
class Label:
    text: str
    at: Point


@dataclass(frozen=True, slots=True)
class Overlays:
    """Polygons, or lines of two points, and labels."""

    shapes: tuple[tuple[Point, ...], ...] = ()
    labels: tuple[Label, ...] = ()


class _Label(msgspec.Struct):
    marker_id: int
    center_norm: Point


class _Tag(msgspec.Struct):
    """A detection of ``apriltag-locations``, or all of ``apriltag-data``, where ``detected`` says if there is a tag."""

    corners_norm: list[Point] | None = None
    marker_id: int | None = None
    center_norm: Point | None = None
    detected: bool = True


class _Form(_Tag):
    """The root object: ``video-overlays`` has ``shapes``, ``apriltag-data`` the fields of a tag."""

    source: str = ""
    shapes: list[list[Point]] = msgspec.field(default_factory=list)
    labels: list[_Label] = msgspec.field(default_factory=list)


def read_overlays(payload: bytes) -> tuple[str, Overlays]:
    """The source and what it draws; the source of a bare list and of ``apriltag-data`` is empty.

    A payload is an object with ``shapes`` and ``labels``, a bare list of shapes or tags, or shaped like
    ``apriltag-data``. Points outside the picture are moved to its edge. Raises PayloadError for everything else.
    """
    if len(payload) > _PAYLOAD_BYTES:
        raise PayloadError(f"{VIDEO_OVERLAYS.metric}: {len(payload)} bytes, more than {_PAYLOAD_BYTES}")
    try:
        form = msgspec.convert(codec.plain(VIDEO_OVERLAYS, payload), _Form | list[_Tag | list[Point]])
    except msgspec.ValidationError as error:
        raise PayloadError(f"{VIDEO_OVERLAYS.metric}: {error}") from None
    if isinstance(form, _Form):
        return form.source, _overlays([form], form.shapes, form.labels)
    tags = [item for item in form if isinstance(item, _Tag)]
    return "", _overlays(tags, [item for item in form if not isinstance(item, _Tag)], [])


class OverlayState:
    """The newest overlays of each source; those without a successor for STALE_S are gone."""

    def __init__(self) -> None:
        self.refused = 0  # payloads
        self._newest: dict[str, tuple[float, Overlays]] = {}

    def receive(self, payload: bytes, now: float) -> None:
        """Take a payload that arrived at ``now``; a malformed one is counted and changes nothing."""
        try:
            source, overlays = read_overlays(payload)
        except PayloadError:
            self.refused += 1
            return
        fresh = {name: held for name, held in self._newest.items() if now - held[0] <= STALE_S and name != source}
        if len(fresh) < _SOURCES:
            self._newest = {**fresh, source: (now, overlays)}

    def current(self, now: float) -> Overlays:
        """What to draw now, of all sources together."""
        fresh = [overlays for arrived, overlays in self._newest.values() if now - arrived <= STALE_S]
        return Overlays(
            tuple(shape for overlays in fresh for shape in overlays.shapes),
            tuple(label for overlays in fresh for label in overlays.labels),
        )


def _overlays(tags: list[_Tag], shapes: list[list[Point]], labels: list[_Label]) -> Overlays:
    tags = [tag for tag in tags if tag.detected and tag.corners_norm]
    outlines = [*shapes, *(tag.corners_norm or [] for tag in tags)]
    named = [Label(str(label.marker_id), _inside(label.center_norm)) for label in labels]
    named += [
        Label(str(tag.marker_id), _inside(tag.center_norm or _mean(tag.corners_norm or [])))
        for tag in tags
        if tag.marker_id is not None
    ]
    drawn = [tuple(map(_inside, outline[:_POINTS])) for outline in outlines if len(outline) >= 2]
    return Overlays(tuple(drawn[:_SHAPES]), tuple(named[:_SHAPES]))


def _mean(points: Iterable[Point]) -> Point:
    xs, ys = zip(*points, strict=True)
    return sum(xs) / len(xs), sum(ys) / len(ys)


def _inside(point: Point) -> Point:
    return min(1.0, max(0.0, point[0])), min(1.0, max(0.0, point[1]))
