"""What a comparison is: a declaration from which its command, its run, its pictures and its part of the report follow.

Its module is imported for the help of its command, too, and by the process that measures: what is large is imported
where it is used.
"""

from __future__ import annotations

import itertools
import math
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace
from importlib import import_module
from pathlib import Path
from typing import Any, Final

from rich.console import Console
from rich.table import Table

from pebble.bench.judging import null
from pebble.bench.results import LONGEST_S, Cell, Judged, Results, Value
from pebble.errors import PebbleError

FOLDER: Final = Path("bench-results")
#: Those that are not in the module of their name.
_ELSEWHERE: Final = {
    "control": "control.cells",
    "video": "wire.video",
    "sound": "wire.sound",
    "impair": "impair.trials",
}
_NAMES: Final = (
    "control", "bridge", "startup", "cost", "frames", "video", "sound", "estop", "fleet", "traffic", "page", "impair",
)  # fmt: skip
#: The module of each comparison, which has it as a constant of the same name; in the order of the report. A module has
#: its modes, too: CONTROL_NULL.
MODULES: Final = {name: _ELSEWHERE.get(name, name.replace("-", "_")) for name in _NAMES}

Params = Mapping[str, Value]
Combine = Callable[[Sequence[Any]], Value]  # the values of all rounds into one
Tables = Callable[[Sequence[Cell]], Iterable[Table]]
Assess = Callable[[Sequence[Cell]], Iterable[str | Judged]]


def of_known(how: Callable[[Sequence[float]], float], digits: int) -> Combine:
    """Joins the values of the rounds that have one; None without any."""
    return lambda values: round(how(known), digits) if (known := [x for x in values if x is not None]) else None


@dataclass(frozen=True, slots=True, kw_only=True)
class Option:
    """One option of the command line. Its defaults are values of the budgets, under the same name."""

    name: str
    help: str
    sets: str = ""  # the value that it sets, if that has another name
    kind: type[Any] = str  # of one value; bool: a flag
    many: bool = False  # several values, separated by commas, or each in an option of its own
    known: Sequence[str] = ()  # the values that there are
    least: float = -math.inf
    most: float = math.inf
    metavar: str | None = None
    recorded: bool = True  # among the options of the results
    private: bool = False  # results name no hosts and files: neither recorded nor, with its value, in their command

    @property
    def key(self) -> str:
        return self.sets or self.name

    def check(self, value: Any) -> None:
        values = list(value) if self.many else [value]
        if unknown := [one for one in values if self.known and one not in self.known]:
            raise PebbleError(f"--{self.name}: unknown {', '.join(unknown)}: there are {', '.join(self.known)}")
        if not values or len(set(values)) < len(values):
            raise PebbleError(f"--{self.name}: name at least one, and each one once")
        for one in values if self.kind in (int, float) else ():
            if not self.least <= one <= self.most:
                raise PebbleError(f"--{self.name} {one}: must be at least {self.least:g} and at most {self.most:g}")

    def words(self, value: Any, default: Any) -> list[str]:
        """The variants as on the command line; names are given only if they are not the default ones."""
        if value is None or value is False or (self.many and list(value) == list(default or ())):
            return []
        shown = str(self.metavar) if self.private else self.as_word(value)
        return [f"--{self.name}", *([] if self.kind is bool else [shown])]

    def as_word(self, value: Any) -> str:
        values = value if self.many else [value]
        return ",".join(f"{one:g}" if isinstance(one, float) else str(one) for one in values)


def rounds(help_: str, *, least: int = 1) -> Option:
    return Option(name="rounds", kind=int, least=least, most=10_000, help=help_)


def seconds(help_: str, *, least: float = 0.1) -> Option:
    return Option(name="seconds", kind=float, least=least, most=LONGEST_S, help=help_)


def variants(known: Sequence[str], help_: str = "Some of them, separated by commas.") -> Option:
    return Option(name="variants", many=True, known=known, metavar="NAMES", help=help_, recorded=False)


class Budget(dict[str, Any]):
    """The defaults of the options and of what else grows with the time spent."""

    def __init__(self, takes_s: int, **values: Any) -> None:
        super().__init__(values)
        self.takes_s = takes_s  # as expected


def unconditional(_run: Run) -> Sequence[Params]:
    """One condition, which has no parameters."""
    return ({},)


def nothing_to_prepare(_run: Run) -> None:
    """Any machine can run it."""


def never_missing(_variant: str) -> str | None:
    """Each variant can be measured."""
    return None


def without_environment(_run: Run) -> AbstractContextManager[Any]:
    return nullcontext()


def all_have_samples(cells: Sequence[Cell]) -> bool:
    return all(cell.samples for cell in cells)


@dataclass(frozen=True, slots=True, kw_only=True)
class Measuring:
    """The engine calls ``measure`` for each case, or ``measure_round`` for each round, which calls :meth:`Round.cases`.

    Both return the cells of one round; cells of the same variant, conditions and measure are joined over the rounds.
    """

    measure: Callable[[Case], Iterable[Cell]] | None = None
    measure_round: Callable[[Round], Iterable[Cell]] | None = None
    prepare: Callable[[Run], None] = nothing_to_prepare  # checks what is needed, and notes; raises PebbleError
    missing: Callable[[str], str | None] = never_missing  # why a variant is left out
    environment: Callable[[Run], AbstractContextManager[Any]] = without_environment  # of ``fresh_every`` rounds
    alone: bool = False  # a case that fails leaves an empty round of its own cells, not of all
    measures: Sequence[str] = ()  # the order of the cells; else as they were measured
    figures: Mapping[str, Combine] = field(default_factory=dict)  # how single values are joined; else the last one


@dataclass(frozen=True, slots=True, kw_only=True)
class Report:
    """How the results are judged and shown, after a run and in the report."""

    tables: Sequence[Tables] = ()  # see pebble.bench.tables
    assessment: Sequence[Assess] = ()  # Claims, Aims and functions, the most important first
    complete: Callable[[Sequence[Cell]], bool] = all_have_samples  # else exit code 1
    pictures: Sequence[Callable[[Results], Iterable[Any]]] = ()  # see pebble.bench.pictures
    reported: Sequence[str] | None = ()  # options in the report; None: it is not part of the report
    reported_full: Sequence[str] = ()  # more of them, of the full run

    def shown(self, cells: Sequence[Cell]) -> list[Table]:
        return [table for tables in self.tables for table in tables(cells)]

    def assessed(self, cells: Sequence[Cell]) -> list[str | Judged]:
        return [line for assess in self.assessment for line in assess(cells)]


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """A command with its options, what it measures, and what its results say."""

    name: str
    title: str
    what: str  # what is measured, and how to read it: for the report
    help: str = ""  # of the command line
    words: Sequence[str] = ()  # what starts its command line after ``pebble``; by default ``bench NAME``
    options: Sequence[Option] = ()
    full: Budget
    quick: Budget
    constants: Mapping[str, Value | list[Value]] = field(default_factory=dict)  # recorded with the options
    folder: Path = FOLDER  # of the results, by default
    root: bool = False  # needs root
    by_name: bool = False  # it takes so long that a report has it only where it is named

    variants: Sequence[str] = ()  # measured in turn; the option of this name chooses some
    references: Sequence[str] = ()  # more of them, which are always measured
    conditions: Callable[[Run], Sequence[Params]] = unconditional
    is_null: bool = False  # one variant in three roles: see pebble.bench.judging.null
    #: What is run instead if this option is given, or (``option=begin``) only values of it that begin so.
    modes: Mapping[str, Comparison] = field(default_factory=dict)

    measuring: Measuring = Measuring()
    report: Report = Report()

    def null_test(
        self, what: str, *, report: dict[str, Any], measuring: dict[str, Any] | None = None, **changes: Any
    ) -> Comparison:
        """The mode of ``--null``: one variant against itself, as it is and slowed down. See pebble.bench.judging.null.

        ``report`` and ``measuring`` are what is different in these parts.
        """
        own = {"name": f"{self.name}-null", "title": f"{self.title}: the null test", "words": ("bench", self.name)}
        shown = {"assessment": (null.assessment,), "reported": ("--null",), **report}
        parts = {"measuring": replace(self.measuring, **(measuring or {})), "report": replace(self.report, **shown)}
        return replace(self, what=what, is_null=True, **{**own, **parts, **changes})

    def arguments(self, quick: bool) -> list[str]:
        """The command line in a report, without ``pebble``."""
        more = ["--quick"] if quick else self.report.reported_full
        return [*(self.words or ("bench", self.name)), *(self.report.reported or ()), *more]

    def mode(self, given: Mapping[str, Any]) -> Comparison:
        """What is to be run with these options."""
        for condition, mode in self.modes.items():
            name, _, begin = condition.partition("=")
            values = given.get(name)
            if values and (not begin or all(str(one).startswith(begin) for one in values)):
                return mode
        return self

    def expected_s(self, quick: bool) -> int:
        return (self.quick if quick else self.full).takes_s

    def run_of(
        self, *, quick: bool = False, output: Path = FOLDER, console: Console | None = None, **options: Any
    ) -> Run:
        """A run with these options; for None, with the defaults. Raises PebbleError for an invalid value."""
        given = {name: value for name, value in options.items() if value is not None}
        own = {"variants": list(self.variants)} if self.variants else {}
        values = {**own, **self.full, **(self.quick if quick else {}), **given}
        for option in self.options:
            if values.get(option.key) is not None:
                option.check(values[option.key])
        return Run(self, values, quick, output, console=console or Console())


@dataclass
class Run:
    """One run of a comparison; its options are looked up as ``run["seconds"]``."""

    comparison: Comparison
    options: dict[str, Any]
    quick: bool = False
    output: Path = FOLDER
    notes: list[str] = field(default_factory=list)  # sentences at the end of the assessment
    recorded: dict[str, Value | list[Value]] = field(default_factory=dict)  # more options of the results
    problem: PebbleError | None = None  # ended the run early, and is raised when the results are written
    console: Console = field(default_factory=Console)
    show: Callable[[str], None] = lambda _text: None  # what is being done

    def __getitem__(self, name: str) -> Any:
        return self.options[name]

    @property
    def rounds(self) -> int:
        return int(self.options.get("rounds", 1))

    @property
    def command(self) -> list[str]:
        """The command line that repeats the run."""
        about = self.comparison
        defaults = {**about.full, **(about.quick if self.quick else {}), "variants": about.variants}
        words = ["pebble", *(about.words or ("bench", about.name))]
        for option in about.options:
            words += option.words(self.options.get(option.key), defaults.get(option.key, ()))
        return [*words, "--quick"] if self.quick else words

    def records(self) -> dict[str, Value | list[Value]]:
        """All options that affect the results."""
        others = {"variants", *(one.key for one in self.comparison.options if one.private or not one.recorded)}
        values = {name: value for name, value in self.options.items() if name not in others}
        return {**values, **self.comparison.constants, **self.recorded}


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """One variant under one condition in one round."""

    run: Run
    number: int  # of the round, from 0
    variant: str
    role: str  # the variant of its cells: another one in a null test
    condition: Params
    planted_us: float = 0.0  # of work for each message in a null test: before its time stamp,
    slowed: bool = False  # or after it
    env: Any = None

    def __str__(self) -> str:
        return ", ".join(filter(None, (self.role, *map(str, self.condition.values()))))

    def cell(
        self, measure: str, unit: str, samples: Iterable[float], params: Params | None = None, **figures: Value
    ) -> Cell:
        of, rounds_ = {**self.condition, **(params or {})}, [list(samples)]
        return Cell(variant=self.role, params=of, measure=measure, unit=unit, rounds=rounds_, figures=figures)


@dataclass(frozen=True, slots=True)
class Round:
    """One round: its cases are in reverse order in every other round and pass."""

    run: Run
    number: int  # from 0
    env: Any
    roles: Sequence[str]
    planted_us: Callable[[Params], float]

    def cases(self, conditions: Sequence[Params] | None = None, passes: int | None = None) -> Iterator[Case]:
        """Measures all conditions, or only these; ``passes`` replaces that of the options.

        Roles of each condition run one after another, so that a temporary disturbance affects all of them.
        """
        run, number = self.run, self.number
        conditions = run.comparison.conditions(run) if conditions is None else conditions
        for pass_ in range(run.options.get("passes", 1) if passes is None else passes):
            step = -1 if (number + pass_) % 2 else 1
            for condition, role in itertools.product(conditions[::step], self.roles[::step]):
                case = Case(
                    run=run, number=number, variant=null.variant_of(role), role=role, condition=condition,
                    slowed=null.is_slowed(role), planted_us=self.planted_us(condition), env=self.env,
                )  # fmt: skip
                run.show(str(case))
                yield case


def find(name: str) -> Comparison:
    """Imports its module."""
    module = MODULES.get(name) or MODULES[name.rpartition("-")[0]]
    found: Comparison = getattr(import_module(f"pebble.bench.{module}"), name.upper().replace("-", "_"))
    return found


def reported() -> list[Comparison]:
    """The comparisons of the report, each followed by its modes."""
    every = [one for about in map(find, MODULES) for one in (about, *about.modes.values())]
    return [one for one in every if one.report.reported is not None]


def chosen(names: Sequence[str]) -> list[Comparison]:
    """Those of these names, in the report's order; without names the usual ones that this user may run.

    Raises PebbleError for an unknown name.
    """
    known = {one.name: one for one in reported()}
    if unknown := [name for name in names if name not in known]:
        raise PebbleError(f"there is no {', '.join(unknown)} in the report: there are {', '.join(known)}")
    may_run = [name for name, one in known.items() if not one.by_name and (not one.root or os.geteuid() == 0)]
    return [one for name, one in known.items() if name in (names or may_run)]
