"""Time stamps in payloads."""

from __future__ import annotations

import math
from typing import Any

import pytest

from pebble.extensions.operator.client.stamps import stamp_of


@pytest.mark.parametrize(
    ("plain", "seconds"),
    [
        ({"t": 1710969600123}, 1710969600.123),
        ({"timestamp": 1710969600.5}, 1710969600.5),
        ({"timestamp": 1710969600123}, 1710969600.123),
        ({"t": 1710969600}, 1710969600.0),
        ({"t": 1710969600123, "timestamp": 1.5e9}, 1710969600.123),
        ({"t": 12345}, None),
        ({"t": "1710969600123"}, None),
        ({"t": math.nan}, None),
        ({"t": 10**400}, None),
        ({"t": -(10**400)}, None),
        ({"t": math.inf}, None),
        ({}, None),
        ([1710969600123], None),
    ],
)
def test_a_stamp_is_milliseconds_or_seconds_by_its_size(plain: Any, seconds: float | None) -> None:
    assert stamp_of(plain) == seconds
