"""A file with the newest run of each other robot that has begun here: no run begins twice, even over restarts."""

from collections.abc import Collection
from pathlib import Path
from typing import Annotated

import msgspec

from pebble.contract.payloads import LAST_RUN
from pebble.errors import PebbleError
from pebble.motion.arbiter import newer
from pebble.runtime.whole_file import make_folder, write

_decode = msgspec.json.Decoder(dict[str, Annotated[int, msgspec.Meta(gt=0, le=LAST_RUN)]]).decode


def begin(path: Path, names: Collection[str], name: str, run: int) -> str:
    """Note that this run of robot ``name`` begins; return why it must not, or "". A run begins only once.

    ``path`` holds the newest run of each of ``names``, the robots that may begin any. If the file cannot be read or
    written, no run begins until it can: otherwise a run that a person has stopped would continue after a restart.
    """
    try:
        newest = _decode(path.read_bytes())
    except FileNotFoundError:
        newest = {}
    except (OSError, msgspec.MsgspecError) as error:
        why = getattr(error, "strerror", None) or "it is damaged"
        return f"{path} cannot be read ({why}): delete it while the scripts of other robots are stopped"
    if not newer(run, newest.get(name, 0)):
        return "it was ended here: start it again"
    newest = {other: last for other, last in newest.items() if other in names} | {name: run}
    try:
        make_folder(path.parent)
        write(path, msgspec.json.encode(newest), 0o600, PebbleError)
    except (OSError, PebbleError) as error:
        return f"its beginning cannot be written: {error}"
    return ""
