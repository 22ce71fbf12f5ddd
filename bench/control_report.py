"""The control comparison's tables and assessment, for a terminal of 80 columns."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from msgspec.structs import replace
from rich.table import Table

from pebble.bench.aims import MISSED, NOT_JUDGED, outcome, single
from pebble.bench.control_participants import BASELINE, HOG, HUB, MEDIA, MQTT, NONE, P2P, VARIANTS
from pebble.bench.null import variant_of
from pebble.bench.ratios import LEAST_ROUNDS, Interval, paired
from pebble.bench.results import Cell, Judged
from pebble.bench.tables import Column, Grid, base_of, figure, plain_table

ONE_WAY, ROUND_TRIP = "one-way", "round trip"
RATE_HZ = 30.0  # of the pictures, as in bench/frames_loop.py
_LONG_US = 995.0
_MUCH_LATE, _MUCH_LOST = 0.05, 0.005
_FEWER = 0.9 * RATE_HZ  # pictures: the load is lighter than intended
AIM_P50, AIM_MEDIA_P99 = 0.70, 0.35
_JUDGED = {"size": "40 B", "rate": "200 Hz"}

_CellsByVariant = dict[tuple[str, str], Cell]  # by variant and load


def legend(cells: Sequence[Cell]) -> list[str]:
    names = dict.fromkeys(variant_of(cell.variant) for cell in cells)
    return [f"{name}: {VARIANTS[name].about}" for name in names]


def tables(cells: Sequence[Cell]) -> list[Table]:
    """One table per measure with a column for each variant; then the ratios to the baseline, if it was measured."""
    measures = list(dict.fromkeys(cell.measure for cell in cells))
    found = [
        _side_by_side(
            f"{measure}, {cells[0].unit}: p50/p99 (k: thousands)",
            [cell for cell in cells if cell.measure == measure],
            lambda cell: f"{_short(cell.percentile(50))}/{_short(cell.percentile(99))}",
        )
        for measure in measures
    ]
    others = [cell for cell in cells if cell.measure == ONE_WAY and cell.variant != BASELINE]
    if others and len(others) < len(cells) / len(measures):
        title = f"{ONE_WAY}, p50 as a ratio to that of {BASELINE}, and its 99 % interval"
        found.append(_side_by_side(title, others, lambda cell: _ratio(cell, base_of(cell, cells, BASELINE))))
    return [*found, *(_HOPS(cells) if any(map(_HOPS.of, cells)) else ())]


def _side_by_side(title: str, cells: Sequence[Cell], shown: Callable[[Cell], str]) -> Table:
    """A row for each condition, a column for each variant."""
    names = list(dict.fromkeys(cell.variant for cell in cells))
    heads = [name.replace("-", "-\n").replace(" ", "\n", 1) for name in names]
    table = plain_table(title, ["size", "Hz", "load", *heads])
    table.padding = 0  # six variants in 80 columns
    for params in dict.fromkeys(tuple(cell.params.items()) for cell in cells):
        row = {cell.variant: shown(cell) for cell in cells if tuple(cell.params.items()) == params}
        conditions = (str(value).removesuffix(" Hz") for _, value in params)
        table.add_row(*conditions, *(row.get(name, "") for name in names))
    return table


def _short(us: float) -> str:
    """Formats microseconds in at most four characters."""
    if us < _LONG_US:
        return figure(us)
    return f"{us / 1000:.1f}k" if us < 10 * _LONG_US else f"{us / 1000:.0f}k"


def _ratio(cell: Cell, base: Cell | None) -> str:
    """Formats a ratio on two lines, so that five fit side by side."""
    if base is None:
        return ""
    interval = paired(cell.rounds, base.rounds)
    if interval.few:
        return str(interval)
    return f"{figure(interval.ratio)}\n{figure(interval.low)}–{figure(interval.high)}"


def wake_up_cost(cells: Sequence[Cell], same_us: float, other_us: float) -> list[str]:
    """The cost of one wake-up on this machine, on the same core and another one, and the wake-ups per message."""
    by_variant, shown = _judged(cells), []
    for name in (_better(by_variant, NONE, 50), P2P):
        figures = by_variant[name, NONE].figures if name and (name, NONE) in by_variant else {}
        ends, backbone = (float(figures.get(key) or 0) for key in ("wake_ups", "broker_wake_ups"))
        if ends:
            shown.append(f"{ends + backbone:.1f} with {name}")
    if not shown:
        return []
    return [
        f"Waking up a waiting process takes {same_us:.0f} us on the same core, {other_us:.0f} us on another; "
        f"a round trip takes {' and '.join(shown)} such wake-ups, including brokers."
    ]


def assessment(cells: Sequence[Cell]) -> list[str | Judged]:
    """One sentence for each comparison that was measured, warnings, and the aims."""
    by_variant = _judged(cells)
    lines = ["40 B at 200 Hz, one way, medians unless p99 is named; with the 99 % interval of the ratio."]
    lines += _against_mqtt(by_variant, NONE, 50) + _against_mqtt(by_variant, MEDIA, 99) + _pictures(by_variant)
    lines += _pair(by_variant, (HUB, NONE), (P2P, NONE), 50)
    lines += [line for name in (P2P, _better(by_variant, NONE, 50)) for line in _with_hog(by_variant, name)]
    for slow in ("paho", "mqtt"):
        for percent in (50, 99):
            lines += _pair(by_variant, (slow, NONE), ("mqtt-nodelay", NONE), percent, why="Nagle: ")
    lines += _pair(by_variant, ("mqtt5", NONE), ("mqtt-nodelay", NONE), 50)
    lines = lines if len(lines) > 1 else []
    return [*lines, *_warnings(cells), *_aims({key: _with_lost(cell) for key, cell in by_variant.items()})]


def _judged(cells: Sequence[Cell]) -> _CellsByVariant:
    return {(cell.variant, str(cell.params["load"])): cell for cell in cells if _is_judged(cell)}


def _is_judged(cell: Cell) -> bool:
    return cell.measure == ONE_WAY and all(cell.params.get(name) == value for name, value in _JUDGED.items())


def _hop(head: str, name: str) -> Column:
    return Column(head, lambda cell: figure(single(name)(cell)))


_HOPS = Grid(
    title="where the time goes: 40 B at 200 Hz, unloaded, medians, us",
    rows=("variant",),
    columns=(
        _hop("publish\ncall", "call_us"),
        _hop("thread\nhas it", "fabric_us"),
        _hop("handler\nruns", "inbox_us"),
        _hop("wake-ups:\nends", "wake_ups"),
        _hop("broker\nor hub", "broker_wake_ups"),
    ),
    of=lambda cell: _is_judged(cell) and cell.params["load"] == NONE and "fabric_us" in cell.figures,
)


def _better(by_variant: _CellsByVariant, load: str, percent: float) -> str | None:
    """The MQTT variant with the lowest percentile."""
    there = [name for name in MQTT if (name, load) in by_variant and by_variant[name, load].samples]
    return min(there, key=lambda name: by_variant[name, load].percentile(percent), default=None)


def _compared(
    by_variant: _CellsByVariant, ours: tuple[str | None, str], theirs: tuple[str | None, str], percent: float
) -> Interval | None:
    a, b = by_variant.get((ours[0] or "", ours[1])), by_variant.get((theirs[0] or "", theirs[1]))
    return None if a is None or b is None else paired(a.rounds, b.rounds, percent)


def _pair(
    by_variant: _CellsByVariant,
    ours: tuple[str, str],
    theirs: tuple[str, str],
    percent: float,
    *,
    why: str = "",
    aside: str = "",
) -> list[str]:
    interval = _compared(by_variant, ours, theirs, percent)
    if interval is None:
        return []
    load = "" if ours[1] == NONE else f"with {ours[1]}, "
    return [f"{why}{load}{_percent(percent)}{interval.words(ours[0], theirs[0] + aside)}"]


def _against_mqtt(by_variant: _CellsByVariant, load: str, percent: float) -> list[str]:
    best = _better(by_variant, load, percent)
    return (
        []
        if best is None
        else _pair(by_variant, (P2P, load), (best, load), percent, aside=" (the better MQTT variant)")
    )


def _pictures(by_variant: _CellsByVariant) -> list[str]:
    """The rate of pictures meanwhile: a variant that carries fewer has a lighter load."""
    rates = {name: cell.figures.get("pictures_hz") for (name, load), cell in by_variant.items() if load == MEDIA}
    known = {name: rate for name, rate in rates.items() if isinstance(rate, (int, float))}
    if not known:
        return []
    shown = ", ".join(f"{name} {figure(rate)}" for name, rate in known.items())
    lines = [f"With media, pictures received per second, of {RATE_HZ:g}: {shown}"]
    fewer = [name for name, rate in known.items() if rate < _FEWER]
    if fewer:
        lines.append(
            f"With media, {', '.join(fewer)}: fewer than {_FEWER:g} pictures per second, so the load was lighter."
        )
    return lines


def _with_hog(by_variant: _CellsByVariant, name: str | None) -> list[str]:
    found = []
    for percent in (50, 99):
        interval = _compared(by_variant, (name, HOG), (name, NONE), percent)
        if interval is not None:
            words = interval.words(f"{name} beside a busy process", f"{name} alone")
            found.append(f"{_percent(percent)}{words}")
    return found


def _percent(percent: float) -> str:
    return "" if percent == 50 else f"p{percent:g}: "


def _warnings(cells: Sequence[Cell]) -> list[str]:
    """Reasons to distrust the results: too few rounds, late or lost messages."""
    rounds = min((len(cell.rounds) for cell in cells), default=0)
    lines = [f"A 99 % interval needs {LEAST_ROUNDS} rounds."] if rounds < LEAST_ROUNDS else []
    for rate in dict.fromkeys(str(cell.params["rate"]) for cell in cells):
        ours = [cell.figures for cell in cells if cell.measure == ONE_WAY and cell.params["rate"] == rate]
        late, sent = (sum(int(figures.get(name) or 0) for figures in ours) for name in ("late", "sent"))
        if late > _MUCH_LATE * sent:
            lines.append(
                f"At {rate} {late / sent:.0%} of the messages were sent late: this machine cannot keep that rate."
            )
        lines += _lost([cell for cell in cells if cell.measure == ONE_WAY and cell.params["rate"] == rate], rate)
    return lines


def _lost(cells: Sequence[Cell], rate: str) -> list[str]:
    shares = {
        name: sum(cell.lost or 0 for cell in cells if cell.variant == name)
        / max(1, sum(int(cell.figures.get("sent") or 0) for cell in cells if cell.variant == name))
        for name in dict.fromkeys(cell.variant for cell in cells)
    }
    shown = ", ".join(f"{share:.1%} of {name}" for name, share in shares.items() if share > _MUCH_LOST)
    return (
        [f"At {rate} messages were lost: {shown}. Percentiles exclude them, aims count them as infinitely late."]
        if shown
        else []
    )


def _with_lost(cell: Cell) -> Cell:
    """Adds the lost messages as infinitely late; each round sends equally many."""
    each = int(cell.figures.get("sent") or 0) // max(1, len(cell.rounds))
    return replace(cell, rounds=[[*one, *[math.inf] * (each - len(one))] for one in cell.rounds])


def _aims(by_variant: _CellsByVariant) -> list[Judged]:
    """The aim for p50 applies to the upper end of the interval, the one for p99 to the ratio, as they were set.

    If too many messages were lost in total, the aim is missed even if few rounds lost them.
    """
    lines = []
    without = _compared(by_variant, (P2P, NONE), (_better(by_variant, NONE, 50), NONE), 50)
    if without is not None:
        lines.append(_aim(f"{P2P} / better MQTT, p50, upper end of the interval", without.high, AIM_P50, without))
    media = _compared(by_variant, (P2P, MEDIA), (_better(by_variant, MEDIA, 99), MEDIA), 99)
    if media is not None:
        value = media.ratio if math.isfinite(by_variant[P2P, MEDIA].percentile(99)) else math.inf
        lines.append(_aim(f"{P2P} / better MQTT with media, p99", value, AIM_MEDIA_P99, media))
    return lines


def _aim(what: str, value: float, aim: float, interval: Interval) -> Judged:
    """A ratio that is equal to 1 within noise does not meet an aim."""
    if interval.few:
        how, why = NOT_JUDGED, f" of {interval.rounds} rounds"
    elif math.isinf(value):
        how, why = MISSED, ", too much was lost"
    elif interval.equal:
        how, why = MISSED, ", equal within noise"
    else:
        how, why = outcome(value <= aim), ""
    return Judged(what=f"{what}, at most {aim:.2f}", outcome=how, measured=f"{interval}{why}")
