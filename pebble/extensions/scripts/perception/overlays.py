"""The contract's payloads about tags: locations, the followed tag, and drawings over the picture."""

from collections.abc import Sequence

import numpy as np
from msgspec import UNSET

from pebble.contract.payloads import Corners, OverlayLabel, TagData, TagDetection, TagLocations, VideoOverlays
from pebble.extensions.scripts.perception.tags import Tag, TagGeometry

Size = tuple[int, int]  # width, height of the picture


def corners_norm(tag: Tag, size: Size) -> Corners:
    """Return the corners as fractions of the picture's size, 0..1."""
    return [(_part(x, size[0]), _part(y, size[1])) for x, y in tag.corners]


def locations(source: str, tags: Sequence[Tag], size: Size, timestamp: float) -> TagLocations:
    detections = [
        TagDetection(marker_id=tag.id, corners_norm=corners, center_norm=_middle(corners))
        for tag, corners in _with_corners(tags, size)
    ]
    return TagLocations(
        source=source, detections=detections, frame_width=size[0], frame_height=size[1], timestamp=timestamp
    )


def overlays(source: str, tags: Sequence[Tag], size: Size, timestamp: float) -> VideoOverlays:
    outlined = _with_corners(tags, size)
    return VideoOverlays(
        source=source,
        shapes=[corners for _, corners in outlined],
        labels=[OverlayLabel(marker_id=tag.id, center_norm=_middle(corners)) for tag, corners in outlined],
        frame_width=size[0],
        frame_height=size[1],
        timestamp=timestamp,
    )


def tag_data(marker_id: int, tag: Tag | None, size: Size, timestamp: float, of: int = 1) -> TagData:
    """Return the followed tag; ``of``: the number of tags with its id in the picture.

    Without a tag, ``corners_norm`` is an empty list, as consumers expect.
    """
    if tag is None:
        return TagData(detected=False, marker_id=marker_id, corners_norm=[], timestamp=timestamp)
    return TagData(
        detected=True,
        marker_id=marker_id,
        corners_norm=corners_norm(tag, size),
        distance_m=tag.distance_m,
        angle_rad=tag.angle_rad,
        timestamp=timestamp,
        of=of if of > 1 else UNSET,
    )


def tags_in(locations: TagLocations, tag_id: int, geometry: TagGeometry) -> list[Tag]:
    """Return the tags with this id that another program has found."""
    size, tags = (locations.frame_width, locations.frame_height), []
    for detection in locations.detections:
        if detection.marker_id == tag_id and len(detection.corners_norm) == 4 and min(size) > 0:
            corners = np.array(detection.corners_norm) * size
            if (place := geometry.place(corners, *size)) is not None:
                tags.append(Tag(tag_id, corners, place))
    return tags


def _with_corners(tags: Sequence[Tag], size: Size) -> list[tuple[Tag, Corners]]:
    return [(tag, corners_norm(tag, size)) for tag in tags]


def _middle(corners: Corners) -> tuple[float, float]:
    return sum(x for x, _ in corners) / 4, sum(y for _, y in corners) / 4


def _part(pixels: float, whole: int) -> float:
    return min(1.0, max(0.0, float(pixels) / whole))
