"""How the comparisons of a report ended: stored beside their results, since a result file does not contain it."""

from __future__ import annotations

from pathlib import Path

import msgspec

from pebble.errors import PebbleError

NAME = "report.json"
HUNG, INTERRUPTED = -1, -2


class Outcome(msgspec.Struct, kw_only=True):
    """One command line of a report: its exit code, and how long it took with all its processes."""

    code: int
    took_s: float
    results: bool = True  # whether it wrote results

    @property
    def problem(self) -> str:
        """Why it failed; empty if it did not."""
        if self.code == HUNG:
            return "hung and was ended"
        if self.code == INTERRUPTED:
            return "was interrupted"
        if self.code:
            return f"ended with code {self.code}"
        return "" if self.results else "measured nothing"


class Run(msgspec.Struct, kw_only=True):
    """The runs that wrote into a folder, by the names of the comparisons."""

    ended: dict[str, Outcome] = {}
    left_out: list[str] = []  # not permitted for this user
    interrupted: str = ""  # in which comparison, after how many

    @property
    def took_s(self) -> float:
        return sum(one.took_s for one in self.ended.values())

    def save(self, folder: Path) -> None:
        """Raises PebbleError if the file cannot be written."""
        try:
            (folder / NAME).write_bytes(msgspec.json.format(msgspec.json.encode(self)) + b"\n")
        except OSError as error:
            raise PebbleError(f"{folder / NAME}: {error.strerror}") from None


def load(folder: Path) -> Run:
    """The state of a folder; empty without the file. Raises PebbleError for an invalid file."""
    path = folder / NAME
    try:
        return msgspec.json.decode(path.read_bytes(), type=Run)
    except FileNotFoundError:
        return Run()
    except (OSError, msgspec.DecodeError) as error:
        raise PebbleError(f"{path} cannot be read: {error}") from None
