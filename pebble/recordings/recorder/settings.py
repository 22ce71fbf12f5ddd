"""What a recorder records, and how: from the command line, or from a file of its own."""

from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec

from pebble.errors import ConfigError
from pebble.recordings.recorder.disk_space import Limits

#: All robots of a broker, and what belongs to no robot.
EVERYTHING = ("+/+/+/#", "+/infrastructure")

Positive = Annotated[float, msgspec.Meta(ge=0.1)]
Size = Annotated[int, msgspec.Meta(ge=0)]


class Options(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How a recorder records; sizes in bytes. 0 in ``keep_…``: no limit."""

    rotate_seconds: Positive = 3600.0
    rotate_bytes: Annotated[int, msgspec.Meta(ge=1 << 16)] = 512 << 20
    keep_bytes: Size = 0
    keep_media_days: Annotated[float, msgspec.Meta(ge=0)] = 0.0
    keep_state_days: Annotated[float, msgspec.Meta(ge=0)] = 0.0
    free_bytes: Size = 2 << 30
    flush_seconds: Positive = 1.0
    sync_seconds: Positive = 5.0
    level: Annotated[int, msgspec.Meta(ge=0, le=19)] = 3  # of Zstandard's compression; 0: none
    queue_bytes: Annotated[int, msgspec.Meta(ge=1 << 18)] = 64 << 20
    media: bool = True

    @property
    def limits(self) -> Limits:
        return Limits(self.keep_bytes, self.keep_media_days, self.keep_state_days, self.free_bytes)


class Connection(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One broker."""

    url: str
    password_file: Path | None = None
    ca_cert: Path | None = None
    filters: Annotated[tuple[str, ...], msgspec.Meta(min_length=1)] = EVERYTHING
    protocol: Literal["5", "3.1.1"] = "5"
    name: str = ""


class Settings(Options, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A recorder's file: ``pebble record --settings FILE``."""

    into: Path = Path("recordings")
    connections: tuple[Connection, ...] = ()


def load(path: Path) -> Settings:
    """Raises ConfigError with one line that names the key. Relative paths start at the folder of ``path``."""
    try:
        settings = msgspec.json.decode(path.read_bytes(), type=Settings, dec_hook=_path)
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}") from None
    except (msgspec.MsgspecError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: {error}") from None
    if not settings.connections:
        raise ConfigError(f'{path}: connections: name at least one, [{{"url": "mqtt://127.0.0.1"}}]')
    return msgspec.structs.replace(settings, into=path.parent / settings.into)


def _path(kind: type[Any], value: Any) -> Any:
    if kind is not Path or not isinstance(value, str):
        raise ValueError("must be a path")
    return Path(value)
