"""Checks as rows of a table, and how such a table is run."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import islice
from typing import Final, Generic, TypeVar

from pebble.check_result import CheckResult, failed, skipped
from pebble.errors import PebbleError

SOON_DAYS: Final = 14  # before its end, a certificate is warned of

Subject = TypeVar("Subject")


def some_of(names: Collection[str], most: int = 3) -> str:
    """Return the first ``most`` names, separated by commas, and the number of the others."""
    more = f", and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(islice(names, most)) + more


@dataclass(frozen=True, slots=True)
class Check(Generic[Subject]):
    """A row of a table of checks.

    ``run`` returns one result, or several if it looks at several things. ``needs`` are called in their order: the first
    text that is not empty is why the check is skipped. ``binds`` returns True if the check applies to the subject at
    all. ``why`` says what goes wrong for people where the check fails.
    """

    name: str
    run: Callable[[Subject], CheckResult | Iterable[CheckResult]]
    needs: tuple[Callable[[Subject], str], ...] = ()
    why: str = ""
    binds: Callable[[Subject], bool] = lambda _: True


def run(
    checks: Iterable[Check[Subject]], subject: Subject, *, refresh: Callable[[], object] = lambda: None
) -> Iterator[tuple[Check[Subject], CheckResult]]:
    """Run the checks in their order; yield each with its results.

    ``refresh`` is called before each check, to read what has arrived.
    """
    for check in checks:
        refresh()
        if not check.binds(subject):
            continue
        lacks = (need(subject) for need in check.needs)
        why = next(filter(None, lacks), "")
        try:
            results = skipped(why) if why else check.run(subject)
            if isinstance(results, CheckResult):
                results = (results,)
            for result in results:
                yield check, replace(result, what=result.what or check.name)
        except (PebbleError, OSError) as error:  # a connection was lost
            yield check, failed(str(error), "run it again", what=check.name)
