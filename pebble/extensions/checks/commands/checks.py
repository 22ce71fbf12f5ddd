"""The output of checks: each result with the fix of a failure, or all as JSON."""

from __future__ import annotations

import json
import shlex
import shutil
import sys
import textwrap
from typing import TYPE_CHECKING

import typer

from pebble.config.secret_text import without_secrets
from pebble.config.visible import shown

if TYPE_CHECKING:
    from pebble.check_result import CheckResult

_COLOURS = {
    "ok": typer.colors.GREEN,
    "warn": typer.colors.YELLOW,
    "failed": typer.colors.RED,
    "skipped": typer.colors.BLUE,
}
_INDENT = " " * 9
_BAD = ("warn", "failed")


class Printer:
    """A printer of results, one by one or, as JSON, at the end. It counts failures and warnings."""

    def __init__(self, config: str = "CONFIG", *, as_json: bool) -> None:
        """Store ``config``, the path that the fixes name as the robot's config file."""
        self.rows: list[dict[str, str]] = []
        self._config, self._as_json = shlex.quote(config), as_json

    def take(self, result: CheckResult, why: str = "") -> None:
        """Print a result; after a bad one also ``why``: what goes wrong for people because of it.

        Texts may come from the robot, so secrets and control characters are masked.
        """
        text = shown(without_secrets(result.text))
        fix = shown(without_secrets(result.fix.replace("CONFIG", self._config)))
        row = {"name": shown(result.what), "state": result.state.value, "text": text, "fix": fix}
        if why and result.state.value in _BAD:
            row["why"] = why
        self.rows.append(row)
        if not self._as_json:
            self._print(row)

    def _print(self, row: dict[str, str]) -> None:
        because = "skipped because " if row["state"] == "skipped" else ""
        typer.secho(f"{row['state']:<7}  ", fg=_COLOURS[row["state"]], nl=False)
        typer.echo(_wrapped(f"{row['name']}: {because}{row['text']}").removeprefix(_INDENT))
        if row["fix"]:  # always on one line: it is to be copied
            typer.secho(f"{_INDENT}fix: {row['fix']}", bold=True)
        if "why" in row:
            typer.echo(_wrapped(f"why: {row['why']}"))

    def names(self, state: str) -> list[str]:
        return [row["name"] for row in self.rows if row["state"] == state]

    def end(self, *, warnings_count: bool = False, **more: object) -> int:
        """Print the summary, or all results as JSON; return 1 if a check failed or a warning counts as a failure."""
        counts = {state: len(self.names(state)) for state in _COLOURS}
        bad = counts["failed"] + (counts["warn"] if warnings_count else 0)
        if self._as_json:
            typer.echo(json.dumps({"ok": not bad, **more, "checks": self.rows}, ensure_ascii=False))
        else:
            skipped = f", skipped: {counts['skipped']}" if counts["skipped"] else ""
            typer.echo(f"checks: {len(self.rows)}, warnings: {counts['warn']}, failures: {counts['failed']}{skipped}")
        return int(bad > 0)


def _wrapped(text: str) -> str:
    width = shutil.get_terminal_size().columns
    return textwrap.fill(text, width, initial_indent=_INDENT, subsequent_indent=_INDENT)


def is_clear(name: str, how: str) -> bool:
    """True if a person confirms that the robot may move. Asks on standard error, as standard output is for results."""
    typer.echo(f"{shown(name)} will drive {how}.", err=True)
    typer.echo("Does it stand free, on the floor, with no person in its way? [y/N]: ", nl=False, err=True)
    if sys.stdin.readline().strip().lower() in ("y", "yes"):
        return True
    typer.echo("nothing was tested", err=True)
    return False
