"""How the comparisons of a report ended: kept beside their results, for what a file of results cannot say of itself."""

from __future__ import annotations

from pathlib import Path

import msgspec

from pebble.errors import PebbleError

NAME = "report.json"
HUNG, INTERRUPTED = -1, -2


class Ended(msgspec.Struct, kw_only=True):
    """One command line of a report: its exit code, and how long it took with all its processes."""

    code: int
    took_s: float
    results: bool = True  # did it leave any?

    @property
    def wrong(self) -> str:
        """What went wrong; empty when nothing did."""
        if self.code == HUNG:
            return "hung and was ended"
        if self.code == INTERRUPTED:
            return "was interrupted"
        if self.code:
            return f"ended with code {self.code}"
        return "" if self.results else "measured nothing"


class Run(msgspec.Struct, kw_only=True):
    """What was run into a folder, by the names of the comparisons."""

    ended: dict[str, Ended] = {}
    left_out: list[str] = []  # this user may not run them
    interrupted: str = ""  # where: in which comparison, after how many

    @property
    def took_s(self) -> float:
        return sum(one.took_s for one in self.ended.values())

    def save(self, folder: Path) -> None:
        """Raises PebbleError where nothing can be written."""
        try:
            (folder / NAME).write_bytes(msgspec.json.format(msgspec.json.encode(self)) + b"\n")
        except OSError as error:
            raise PebbleError(f"{folder / NAME}: {error.strerror}") from None


def load(folder: Path) -> Run:
    """Nothing is known of a folder without that file. Raises PebbleError for what is none of ours."""
    path = folder / NAME
    try:
        return msgspec.json.decode(path.read_bytes(), type=Run)
    except FileNotFoundError:
        return Run()
    except (OSError, msgspec.DecodeError) as error:
        raise PebbleError(f"{path} cannot be read: {error}") from None
