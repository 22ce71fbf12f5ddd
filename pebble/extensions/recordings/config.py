"""The config section of the robot's own recorder."""

from pathlib import Path
from typing import Annotated, ClassVar

from msgspec import Meta

from pebble.config.home import in_home
from pebble.config.types import ONE_VALUE, File, Seconds, ServiceSection, doc

Bytes = Annotated[int, Meta(ge=0, le=1 << 50)]


class Recorder(ServiceSection, frozen=True, kw_only=True):
    """Records what the robot's processes publish, into MCAP files: docs/ext/recordings.md.

    It needs `pip install 'pebble-robot[record]'`.
    """

    retired: ClassVar = {
        **dict.fromkeys(("rotate_seconds", "rotate_bytes", "free_bytes", "sync_seconds", "level"), ONE_VALUE),
        "keep_state_days": "`keep_bytes` deletes the oldest, and `keep_media_days` pictures and sound",
    }

    folder: Annotated[File | None, doc("Folder of the recordings; unset: `~/recordings`.")] = None
    remote: Annotated[bool, doc("Record the remote broker's side as well, where pictures and sound are.")] = False
    media: Annotated[bool, doc("Record pictures and sound.")] = True
    keep_bytes: Annotated[Bytes, doc("Size of all; the oldest are deleted beyond it. 0: no limit.")] = 2 << 30
    keep_media_days: Annotated[Seconds, doc("Days after which pictures and sound are deleted. 0: never.")] = 0.0

    @property
    def place(self) -> Path:
        """Return the folder for recordings, also if the config names none."""
        return self.folder or in_home("~/recordings")
