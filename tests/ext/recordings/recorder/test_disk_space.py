"""Which recordings make room for new ones, by their size and by their age."""

from __future__ import annotations

from pathlib import Path

import pytest

from pebble.extensions.recordings.recorder.disk_space import Disk, outdated, surplus
from pebble.extensions.recordings.recorder.folder import Entry
from pebble.extensions.recordings.recorder.settings import Options

NOW, DAY_S = 1_760_000_000.0, 86_400.0
MEDIA = "media.pebble.robots.goob"
MUCH = Disk(1 << 40)


def entry(number: int, lane: str = "state", days: float = 0.0, ending: str = "") -> Entry:
    """A file of 10 bytes."""
    return Entry(Path(f"{number}.{lane}.mcap{ending}"), number, lane, 10, NOW - days * DAY_S)


STATE = [entry(number) for number in (1, 3, 5)]
BOTH = [*STATE, *(entry(number, MEDIA) for number in (2, 4, 6))]


@pytest.mark.parametrize(
    ("entries", "limits", "disk", "deleted"),
    [
        (BOTH, Options(free_bytes=0), MUCH, []),
        (BOTH, Options(keep_bytes=60), MUCH, []),
        (BOTH, Options(keep_bytes=45), MUCH, [2, 4]),
        (BOTH, Options(keep_bytes=1), MUCH, [2, 4, 1, 3]),
        ([*STATE, entry(9, ending=".active")], Options(keep_bytes=35), MUCH, [1]),
        ([*STATE, entry(9, ending=".damaged")], Options(keep_bytes=35), MUCH, []),
        (BOTH, Options(free_bytes=115), Disk(100), [2, 4]),
        (BOTH, Options(free_bytes=115), Disk(100, size_bytes=1000), []),
        (BOTH, Options(free_bytes=115), Disk(95, size_bytes=1000), [2]),
        (BOTH, Options(free_bytes=115), Disk(0, size_bytes=0), []),
        (BOTH, Options(free_bytes=0), Disk(100, has_inodes=False), [2]),
    ],
)
def test_the_oldest_go_and_pictures_before_state(
    entries: list[Entry], limits: Options, disk: Disk, deleted: list[int]
) -> None:
    assert [one.number for one in surplus(entries, limits, disk)] == deleted


OLD = [entry(1, days=9), entry(2, MEDIA, days=8), entry(3, days=3), entry(4, MEDIA, days=2), entry(5), entry(6, MEDIA)]


@pytest.mark.parametrize(
    ("entries", "limits", "found"),
    [
        (OLD, Options(), None),
        (OLD, Options(keep_media_days=7), 2),
        (OLD, Options(keep_media_days=10), None),
        (OLD[:2], Options(keep_media_days=1), None),
    ],
)
def test_one_that_is_too_old_but_never_the_newest_of_its_kind(
    entries: list[Entry], limits: Options, found: int | None
) -> None:
    old = outdated(entries, limits, NOW)
    assert (None if old is None else old.number) == found
