"""The config section of the robot's own recorder."""

from pathlib import Path
from typing import Annotated

from msgspec import Meta

from pebble.config.home import in_home
from pebble.config.types import File, Interval, Seconds, ServiceSection, doc

Bytes = Annotated[int, Meta(ge=0, le=1 << 50)]


class Recorder(ServiceSection, frozen=True, kw_only=True):
    """Records what the robot's processes publish, into MCAP files: docs/recordings.md."""

    folder: Annotated[File | None, doc("Folder of the recordings; unset: `~/recordings`.")] = None
    remote: Annotated[bool, doc("Record the remote broker's side as well, where pictures and sound are.")] = False
    media: Annotated[bool, doc("Record pictures and sound.")] = True
    rotate_seconds: Annotated[Interval, doc("How long one file is written.")] = 3600.0
    rotate_bytes: Annotated[Bytes, doc("Its size at which the next one begins.")] = 512 << 20
    keep_bytes: Annotated[Bytes, doc("Size of all; the oldest are deleted beyond it. 0: no limit.")] = 2 << 30
    keep_media_days: Annotated[Seconds, doc("Days after which pictures and sound are deleted. 0: never.")] = 0.0
    keep_state_days: Annotated[Seconds, doc("Days after which everything else is deleted. 0: never.")] = 0.0
    free_bytes: Annotated[Bytes, doc("What stays free on the disk.")] = 1 << 30
    sync_seconds: Annotated[Interval, doc("How often all is made durable: a power cut loses as much.")] = 5.0
    level: Annotated[int, Meta(ge=0, le=19, description="Zstandard's level; 0: no compression.")] = 3

    @property
    def place(self) -> Path:
        """The folder, also where none is named."""
        return self.folder or in_home("~/recordings")
