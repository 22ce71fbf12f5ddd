"""Overlays in every form that viewers accept, and when they are gone."""

from __future__ import annotations

import json
from typing import Any

import pytest

from pebble.client.overlays import STALE_S, Label, Overlays, OverlayState, read_overlays
from pebble.errors import PayloadError

SQUARE = [[0.1, 0.2], [0.2, 0.2], [0.2, 0.3], [0.1, 0.3]]
CORNERS = ((0.1, 0.2), (0.2, 0.2), (0.2, 0.3), (0.1, 0.3))
LABELLED = Overlays((CORNERS,), (Label("13", (0.15, 0.25)),))


def payload(body: Any) -> bytes:
    return json.dumps(body).encode()


def form(source: str = "apriltag-locations", **changed: Any) -> bytes:
    """The paper's example."""
    labels = [{"marker_id": 13, "center_norm": [0.15, 0.25]}]
    body = {"source": source, "shapes": [SQUARE], "labels": labels, "frame_width": 640, "frame_height": 480}
    return payload(body | {"timestamp": 1710969600.123} | changed)


def read(raw: bytes) -> Overlays:
    """Label positions are rounded: a mean of corners is not exact."""
    overlays = read_overlays(raw)[1]
    labels = tuple(Label(one.text, (round(one.at[0], 6), round(one.at[1], 6))) for one in overlays.labels)
    return Overlays(overlays.shapes, labels)


@pytest.mark.parametrize(
    ("raw", "overlays"),
    [
        (form(), LABELLED),
        (form(labels=[]), Overlays((CORNERS,))),
        (form(shapes=[], labels=[]), Overlays()),
        (payload([SQUARE]), Overlays((CORNERS,))),
        (payload([{"marker_id": 13, "corners_norm": SQUARE, "center_norm": [0.15, 0.25]}]), LABELLED),
        (payload({"detected": True, "marker_id": 13, "corners_norm": SQUARE, "distance_m": 0.74}), LABELLED),
        (payload({"detected": False, "marker_id": 13, "corners_norm": []}), Overlays()),
        (payload({"detected": False, "marker_id": 13, "corners_norm": SQUARE}), Overlays()),
        (payload([]), Overlays()),
    ],
)
def test_every_form(raw: bytes, overlays: Overlays) -> None:
    assert read(raw) == overlays


def test_points_outside_the_picture_are_at_its_edge() -> None:
    outside = form(shapes=[[[-5, 0.5], [1.5, 1e300]]], labels=[{"marker_id": 1, "center_norm": [2, -1]}])
    assert read(outside) == Overlays((((0.0, 0.5), (1.0, 1.0)),), (Label("1", (1.0, 0.0)),))


def test_a_shape_of_one_point_is_left_out_and_the_rest_is_bounded() -> None:
    assert read(form(shapes=[[[0.1, 0.1]], SQUARE], labels=[])) == Overlays((CORNERS,))
    many = read(form(shapes=[SQUARE] * 300, labels=[]))
    assert len(many.shapes) == 100
    assert len(read(form(shapes=[[[0.5, 0.5]] * 900], labels=[])).shapes[0]) == 500


@pytest.mark.parametrize(
    "raw",
    [
        *(b"", b"\xff", b"[", b"7", b"null", b'"x"', b"[" * 40 + b"]" * 40, b" " * 70_000 + b"[]"),
        *(form(shapes=[[["a", 1], [1, 1]]]), form(shapes=[[[1], [1, 2]]]), form(labels=[{"marker_id": "x"}])),
        *(form(shapes=None), payload([7]), payload({"corners_norm": 3})),
    ],
)
def test_what_is_malformed_is_refused_and_changes_nothing(raw: bytes) -> None:
    with pytest.raises(PayloadError, match="video-overlays"):
        read_overlays(raw)
    state = OverlayState()
    state.receive(form(), 0.0)
    state.receive(raw, 0.1)
    assert (state.current(0.2), state.refused) == (LABELLED, 1)


def test_stale_overlays_vanish_and_newer_ones_replace_their_own_source_only() -> None:
    state = OverlayState()
    state.receive(form(), 0.0)
    state.receive(form("other", labels=[]), 0.5)
    assert len(state.current(0.9).shapes) == 2
    assert state.current(STALE_S + 0.1) == Overlays((CORNERS,))
    assert state.current(STALE_S + 0.6) == Overlays()
    state.receive(form(), 2.0)
    state.receive(form(shapes=[], labels=[]), 2.1)  # what a script publishes when it ends
    assert state.current(2.1) == Overlays()


def test_the_number_of_sources_is_bounded() -> None:
    state = OverlayState()
    for number in range(20):
        state.receive(form(f"source {number}", labels=[]), 0.0)
    assert len(state.current(0.0).shapes) == 8
    state.receive(form("late"), 5.0)
    assert state.current(5.0) == LABELLED
