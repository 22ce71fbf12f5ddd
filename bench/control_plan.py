"""The options of the control comparison: variants, conditions, durations and numbers of rounds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from pebble.bench.comparison import FOLDER
from pebble.bench.control_variants import P2P, VARIANTS
from pebble.bench.control_wire import SMALLEST
from pebble.bench.null import roles, variant_of
from pebble.bench.results import LONGEST_S, Value
from pebble.errors import PebbleError

NONE, MEDIA, HOG = LOADS = ("none", "media", "hog")
SIZES = (40, 1024)
RATES = (20.0, 200.0, 1000.0)
LOADED_SIZE, LOADED_RATES = 40, (20.0, 200.0)  # with a load, unless given
_LARGEST, _FASTEST = 1 << 20, 2000.0


@dataclass(frozen=True, slots=True)
class Condition:
    """A condition under which all variants are measured in turn."""

    size: int
    rate: float
    load: str

    @property
    def params(self) -> dict[str, Value]:
        return {"size": size_name(self.size), "rate": rate_name(self.rate), "load": self.load}


def size_name(size: int) -> str:
    return f"{size // 1024} KB" if size % 1024 == 0 else f"{size} B"


def rate_name(rate: float) -> str:
    return f"{rate:g} Hz"


@dataclass(frozen=True, slots=True, kw_only=True)
class ControlPlan:
    """A round runs every role under every condition, ``passes`` times in turn.

    All processes are new in every ``fresh_every``-th round.
    """

    roles: Sequence[str] = tuple(VARIANTS)
    conditions: Sequence[Condition]
    seconds: float
    rounds: int
    passes: int = 1
    fresh_every: int = 1
    null: bool = False
    quick: bool = False
    output: Path = FOLDER
    command: Sequence[str] = ()

    @staticmethod
    def of(
        *,
        variants: Sequence[str] | None = None,
        sizes: Sequence[int] | None = None,
        rates: Sequence[float] | None = None,
        loads: Sequence[str] | None = None,
        seconds: float | None = None,
        rounds: int | None = None,
        quick: bool = False,
        null: bool = False,
        output: Path = FOLDER,
    ) -> ControlPlan:
        """The plan for the command line's options. Raises PebbleError naming an invalid option."""
        if null and len(variants or (P2P,)) > 1:
            raise PebbleError("--null takes one variant: --variants zenoh-p2p")
        base = _null_plan(variants, quick) if null else _quick_plan() if quick else _full_plan()
        plan = replace(
            base,
            roles=base.roles if variants is None or null else tuple(variants),
            conditions=_asked(base.conditions, sizes, rates, loads),
            seconds=base.seconds if seconds is None else seconds,
            rounds=base.rounds if rounds is None else rounds,
            output=output,
            command=command_of(
                {
                    "variants": variants,
                    "sizes": sizes,
                    "rates": rates,
                    "loads": loads,
                    "seconds": seconds,
                    "rounds": rounds,
                },
                quick=quick,
                null=null,
            ),
        )
        plan.check()
        return plan

    @property
    def bench(self) -> str:
        return "control-null" if self.null else "control"

    @property
    def loads(self) -> tuple[str, ...]:
        return tuple(load for load in LOADS if load in {condition.load for condition in self.conditions})

    def check(self) -> None:
        """Raises PebbleError naming an invalid option."""
        unknown = [name for name in map(variant_of, self.roles) if name not in VARIANTS]
        if unknown or not self.roles:
            raise PebbleError(f"unknown variant {', '.join(unknown)}: there are {', '.join(VARIANTS)}")
        if len(set(self.roles)) < len(self.roles):
            raise PebbleError("a variant is named twice")
        strange = [condition.load for condition in self.conditions if condition.load not in LOADS]
        if strange:
            raise PebbleError(f"unknown load {strange[0]}: there are {', '.join(LOADS)}")
        check_slices(
            [condition.size for condition in self.conditions],
            [condition.rate for condition in self.conditions],
            self.seconds,
            self.rounds,
        )


def check_slices(sizes: Sequence[int], rates: Sequence[float], seconds: float, rounds: int) -> None:
    """Raises PebbleError naming an invalid option."""
    if not all(SMALLEST <= size <= _LARGEST for size in sizes):
        raise PebbleError(f"a size is between {SMALLEST} (stamps) and {_LARGEST} bytes")
    if not all(1 <= rate <= _FASTEST for rate in rates):
        raise PebbleError(f"a rate is between 1 and {_FASTEST:g} messages a second")
    if not 0 < seconds <= LONGEST_S or rounds < 1:
        raise PebbleError(f"seconds and rounds must be positive, and seconds at most {LONGEST_S:.0f}")


def _full_plan() -> ControlPlan:
    unloaded = [Condition(size, rate, NONE) for size in SIZES for rate in RATES]
    loaded = [Condition(LOADED_SIZE, rate, load) for load in (MEDIA, HOG) for rate in LOADED_RATES]
    return ControlPlan(conditions=(*unloaded, *loaded), seconds=0.35, passes=2, rounds=10)


def _quick_plan() -> ControlPlan:
    conditions = [Condition(40, 200.0, load) for load in (NONE, MEDIA)]
    return ControlPlan(conditions=conditions, seconds=0.3, rounds=4, fresh_every=2, quick=True)


def _null_plan(variants: Sequence[str] | None, quick: bool) -> ControlPlan:
    return ControlPlan(
        roles=roles(variants[0] if variants else P2P),
        conditions=(Condition(40, 200.0, NONE),),
        seconds=0.25 if quick else 0.3,
        passes=1 if quick else 2,
        rounds=4 if quick else 30,
        fresh_every=2 if quick else 1,
        null=True,
        quick=quick,
    )


def _asked(
    conditions: Sequence[Condition],
    sizes: Sequence[int] | None,
    rates: Sequence[float] | None,
    loads: Sequence[str] | None,
) -> tuple[Condition, ...]:
    """With sizes or rates given: all of them with every load; else the plan's conditions with these loads."""
    wanted = tuple(dict.fromkeys(loads if loads is not None else (condition.load for condition in conditions)))
    if sizes is None and rates is None and set(wanted) <= {condition.load for condition in conditions}:
        return tuple(condition for condition in conditions if condition.load in wanted)
    ours = [condition for condition in conditions if condition.load == NONE]
    each_size = tuple(dict.fromkeys(condition.size for condition in ours)) if sizes is None else tuple(sizes)
    each_rate = tuple(dict.fromkeys(condition.rate for condition in ours)) if rates is None else tuple(rates)
    return tuple(Condition(size, rate, load) for load in wanted for size in each_size for rate in each_rate)


def command_of(asked: Mapping[str, object], **flags: bool) -> list[str]:
    """The command line that repeats the run, without the defaults."""
    words = ["pebble", "bench", "control", *(f"--{name}" for name, given in flags.items() if given)]
    for name, value in asked.items():
        if value is not None:
            words += [f"--{name}", ",".join(map(_word, value)) if isinstance(value, (list, tuple)) else _word(value)]
    return words


def _word(value: object) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)
