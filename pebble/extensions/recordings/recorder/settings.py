"""The options of a recorder."""

from typing import Final

import msgspec

#: All robots of a broker, and what belongs to no robot.
EVERYTHING: Final = ("+/+/+/#", "+/infrastructure")


class Options(msgspec.Struct, frozen=True, kw_only=True):
    """The options of a recorder; sizes in bytes. 0 in ``keep_…``: no limit; ``free_bytes`` stay free on the disk."""

    rotate_seconds: float = 3600.0
    keep_bytes: int = 0
    keep_media_days: float = 0.0
    free_bytes: int = 1 << 30
    media: bool = True
