"""What other readers of MCAP find in a recording, all checksums compared."""

from __future__ import annotations

import subprocess
from pathlib import Path
from typing import NamedTuple

from mcap.reader import make_reader
from mcap.stream_reader import StreamReader

from tests.kit.npm import package


class Counted(NamedTuple):
    """Messages of a file."""

    statistics: int
    indexed: int
    streamed: int


def by_mcap(path: Path) -> Counted:
    """The messages as the package ``mcap`` reads them."""
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        indexed = sum(1 for _ in reader.iter_messages())
        file.seek(0)
        names = [type(record).__name__ for record in StreamReader(file, validate_crcs=True).records]
        return Counted(summary.statistics.message_count, indexed, names.count("Message"))


def by_mcap_core(paths: list[Path]) -> list[Counted]:
    """The messages of each file as npm's ``@mcap/core`` reads them."""
    package("@mcap/core")
    command = ["node", Path(__file__).with_name("mcap_core.cjs"), *paths]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=300)
    assert (done.returncode, done.stderr) == (0, "")
    return [Counted(*map(int, line.split())) for line in done.stdout.splitlines()]
