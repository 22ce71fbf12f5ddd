"""Notices that a robot has another name than before: brokers go on retaining what it published under the old one."""

import logging

from pebble.config import Config
from pebble.config.config import file_name
from pebble.errors import PebbleError
from pebble.runtime.whole_file import make_folder, write

log = logging.getLogger(__name__)

_LONGEST = 1000  # bytes of a name


def note_name(config: Config) -> None:
    """Remember the robot's name beside its state, and warn if it was another one at the last start."""
    if config.path is None:  # several robots may share a state directory, but not a config
        return
    folder = config.state_dir()
    if folder.name == file_name(config.base):  # by default each name has a folder of its own
        folder = folder.parent
    file = folder / f"name-{file_name(str(config.path.resolve()))}"
    name = config.base.encode()
    try:
        earlier = file.read_bytes()[:_LONGEST] if file.is_file() else b""
        if earlier == name:
            return
        make_folder(folder)
        write(file, name, 0o600, PebbleError)
    except (PebbleError, OSError) as error:
        log.warning("its name cannot be remembered: %s", error)
        return
    if earlier:
        text = "its name was %s before: what brokers retain under that stays: see `pebble doctor --running`"
        log.warning(text, earlier.decode(errors="replace"))
