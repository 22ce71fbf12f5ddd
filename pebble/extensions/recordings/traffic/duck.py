"""DuckDB with little memory, for the index and the analysis."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Final

from pebble.errors import PebbleError
from pebble.extensions.recordings.files.recorded import RecordingError

if TYPE_CHECKING:
    from duckdb import DuckDBPyConnection

_GLOB: Final = re.compile(r"([*?\[])")


def require_packages(*names: str) -> None:
    """Raise PebbleError that names the packages of the extra "archive" that are not installed."""
    missing = [name for name in names if find_spec(name) is None]
    if missing:
        raise PebbleError(f'{" and ".join(missing)} missing: pip install "pebble-robot[archive]"')


@contextmanager
def connected(scratch: Path, *, memory_mb: int, threads: int = 1) -> Iterator[DuckDBPyConnection]:
    """Yield a database in memory, with overflow files below ``scratch``.

    Raises PebbleError without DuckDB, and RecordingError for errors of DuckDB.
    """
    require_packages("duckdb")
    import duckdb

    config: dict[str, str | bool | int | float | list[str]] = {
        "memory_limit": f"{memory_mb}MB",
        "threads": threads,
        "temp_directory": str(scratch / "duckdb"),
    }
    try:
        with duckdb.connect(config=config) as connection:
            yield connection
    except duckdb.Error as error:
        raise RecordingError(f"DuckDB: {str(error).partition(chr(10))[0]}") from None


def quoted(value: object) -> str:
    """Return a text as an SQL literal."""
    return "'" + str(value).replace("'", "''") + "'"


def parquet(paths: Iterable[Path]) -> str:
    """Return an SQL table of the rows of Parquet files.

    Names are not patterns: a folder may be called ``[1]``.
    """
    names = (quoted(Path(_GLOB.sub(r"[\1]", str(path)))) for path in paths)
    return f"read_parquet([{', '.join(names)}], hive_partitioning = false)"
