"""The control comparison's cells in words and tables that fit a terminal of 80 columns."""

from __future__ import annotations

import math
from collections.abc import Sequence

from msgspec.structs import replace
from rich.table import Table

from pebble.bench.control_plan import HOG, LOADED_SIZE, MEDIA, NONE, rate_name, size_name
from pebble.bench.control_variants import BASELINE, HUB, MQTT, P2P, VARIANTS
from pebble.bench.frames_loop import RATE_HZ
from pebble.bench.null import variant_of
from pebble.bench.ratios import LEAST_ROUNDS, Interval, paired
from pebble.bench.results import Cell
from pebble.bench.tables import base_of, figure, plain_table

ONE_WAY, ROUND_TRIP = "one-way", "round trip"
MEASURES = {ONE_WAY: "one_way", ROUND_TRIP: "round_trip"}  # and the field of a worker's answer
_LONG_US = 995.0
_MUCH_LATE, _MUCH_LOST = 0.05, 0.005
_FEWER = 0.9 * RATE_HZ  # pictures: a lighter load than was meant
AIM_P50, AIM_MEDIA_P99 = 0.70, 0.35
_JUDGED = {"size": size_name(LOADED_SIZE), "rate": rate_name(200)}


_Ways = dict[tuple[str, str], Cell]  # by variant and load


def legend(roles: Sequence[str]) -> list[str]:
    names = dict.fromkeys(variant_of(role) for role in roles)
    return [f"{name}: {VARIANTS[name].about}" for name in names]


def tables(cells: Sequence[Cell]) -> list[Table]:
    """One per measure, a column for each variant; last, how the variants compare with the baseline, if it is there."""
    measures = list(dict.fromkeys(cell.measure for cell in cells))
    found = [_times([cell for cell in cells if cell.measure == measure], measure) for measure in measures]
    others = [cell for cell in cells if cell.measure == ONE_WAY and cell.variant != BASELINE]
    if others and len(others) < len(cells) / len(measures):
        found.append(_ratios(others, cells))
    known = [cell for cell in cells if _is_judged(cell) and cell.params["load"] == NONE and "fabric_us" in cell.figures]
    return [*found, _hops(known)] if known else found


def _times(cells: Sequence[Cell], measure: str) -> Table:
    names = list(dict.fromkeys(cell.variant for cell in cells))
    table = _table(f"{measure}, {cells[0].unit}: p50/p99 (k: thousands)", names)
    for row in _by_condition(cells):
        by_name = {cell.variant: f"{_short(cell.percentile(50))}/{_short(cell.percentile(99))}" for cell in row}
        table.add_row(*_conditions(row[0]), *(by_name.get(name, "") for name in names))
    return table


def _ratios(cells: Sequence[Cell], everybody: Sequence[Cell]) -> Table:
    names = list(dict.fromkeys(cell.variant for cell in cells))
    table = _table(f"{ONE_WAY}, p50 as a ratio to that of {BASELINE}, and its 99 % interval", names)
    for row in _by_condition(cells):
        by_name = {cell.variant: _ratio(cell, base_of(cell, everybody, BASELINE)) for cell in row}
        table.add_row(*_conditions(row[0]), *(by_name.get(name, "") for name in names))
    return table


def _hops(cells: Sequence[Cell]) -> Table:
    heads = ["publish\ncall", "thread\nhas it", "handler\nruns", "wake-ups:\nends", "broker\nor hub"]
    table = plain_table("where the time goes: 40 B at 200 Hz, unloaded, medians, us", ["variant", *heads])
    for cell in cells:
        known = (cell.figures.get(name) for name in ("call_us", "fabric_us", "inbox_us", "wake_ups", "broker_wake_ups"))
        table.add_row(cell.variant, *(figure(math.nan if value is None else float(value)) for value in known))
    return table


def _short(us: float) -> str:
    """At most four characters."""
    if us < _LONG_US:
        return figure(us)
    return f"{us / 1000:.1f}k" if us < 10 * _LONG_US else f"{us / 1000:.0f}k"


def _ratio(cell: Cell, base: Cell | None) -> str:
    """In two lines: five of these stand side by side."""
    if base is None:
        return ""
    interval = paired(cell.rounds, base.rounds)
    if interval.few:
        return str(interval)
    return f"{figure(interval.ratio)}\n{figure(interval.low)}–{figure(interval.high)}"


def _conditions(cell: Cell) -> list[str]:
    return [str(value).removesuffix(" Hz") for value in cell.params.values()]


def _by_condition(cells: Sequence[Cell]) -> list[list[Cell]]:
    conditions = dict.fromkeys(tuple(cell.params.items()) for cell in cells)
    return [[cell for cell in cells if tuple(cell.params.items()) == params] for params in conditions]


def _table(title: str, names: Sequence[str]) -> Table:
    heads = [name.replace("-", "-\n").replace(" ", "\n", 1) for name in names]
    table = plain_table(title, ["size", "Hz", "load", *heads])
    table.padding = 0  # six variants in 80 columns
    return table


def waking(cells: Sequence[Cell], same_us: float, other_us: float) -> list[str]:
    """What one wake-up costs here, on the same core and on another one, beside how many of them a message takes."""
    ways, told = _judged(cells), []
    for name in (_better(ways, NONE, 50), P2P):
        figures = ways[name, NONE].figures if name and (name, NONE) in ways else {}
        ends, backbone = (float(figures.get(key) or 0) for key in ("wake_ups", "broker_wake_ups"))
        if ends:
            told.append(f"{ends + backbone:.1f} with {name}")
    if not told:
        return []
    return [
        f"A process that waits is woken up within {same_us:.0f} us on the same core, {other_us:.0f} us on another; "
        f"there and back a message takes {' and '.join(told)} such wake-ups, brokers included."
    ]


def verdict(cells: Sequence[Cell]) -> list[str]:
    """Plain sentences; what was not measured is not spoken of."""
    ways = _judged(cells)
    said = ["40 B at 200 Hz, one way, medians unless p99 is named; in brackets the 99 % interval of the ratio."]
    said += _against_mqtt(ways, NONE, 50) + _against_mqtt(ways, MEDIA, 99) + _pictures(ways)
    said += _pair(ways, (HUB, NONE), (P2P, NONE), 50)
    said += [line for name in (P2P, _better(ways, NONE, 50)) for line in _with_hog(ways, name)]
    for slow in ("paho", "mqtt"):
        for percent in (50, 99):
            said += _pair(ways, (slow, NONE), ("mqtt-nodelay", NONE), percent, why="Nagle: ")
    said += _pair(ways, ("mqtt5", NONE), ("mqtt-nodelay", NONE), 50)
    said = said if len(said) > 1 else []
    return said + _doubts(cells) + _aims({key: _with_lost(cell) for key, cell in ways.items()})


def _judged(cells: Sequence[Cell]) -> _Ways:
    return {(cell.variant, str(cell.params["load"])): cell for cell in cells if _is_judged(cell)}


def _is_judged(cell: Cell) -> bool:
    return cell.measure == ONE_WAY and all(cell.params.get(name) == value for name, value in _JUDGED.items())


def _better(ways: _Ways, load: str, percent: float) -> str | None:
    """The MQTT variant with the lowest percentile."""
    there = [name for name in MQTT if (name, load) in ways and ways[name, load].samples]
    return min(there, key=lambda name: ways[name, load].percentile(percent), default=None)


def _compared(
    ways: _Ways, ours: tuple[str | None, str], theirs: tuple[str | None, str], percent: float
) -> Interval | None:
    a, b = ways.get((ours[0] or "", ours[1])), ways.get((theirs[0] or "", theirs[1]))
    return None if a is None or b is None else paired(a.rounds, b.rounds, percent)


def _pair(
    ways: _Ways, ours: tuple[str, str], theirs: tuple[str, str], percent: float, *, why: str = "", aside: str = ""
) -> list[str]:
    interval = _compared(ways, ours, theirs, percent)
    if interval is None:
        return []
    load = "" if ours[1] == NONE else f"with {ours[1]}, "
    return [f"{why}{load}{_percent(percent)}{interval.words(ours[0], theirs[0] + aside)}"]


def _against_mqtt(ways: _Ways, load: str, percent: float) -> list[str]:
    best = _better(ways, load, percent)
    return [] if best is None else _pair(ways, (P2P, load), (best, load), percent, aside=" (the better MQTT variant)")


def _pictures(ways: _Ways) -> list[str]:
    """What flowed beside the messages: a variant that carries less of it has it easier."""
    rates = {name: cell.figures.get("pictures_hz") for (name, load), cell in ways.items() if load == MEDIA}
    known = {name: rate for name, rate in rates.items() if isinstance(rate, (int, float))}
    if not known:
        return []
    told = ", ".join(f"{name} {figure(rate)}" for name, rate in known.items())
    said = [f"With media, pictures a second that arrived meanwhile, of {RATE_HZ:g}: {told}"]
    fewer = [name for name, rate in known.items() if rate < _FEWER]
    if fewer:
        said.append(f"With media, {', '.join(fewer)}: fewer pictures than {_FEWER:g}, so figures of a lighter load.")
    return said


def _with_hog(ways: _Ways, name: str | None) -> list[str]:
    found = []
    for percent in (50, 99):
        interval = _compared(ways, (name, HOG), (name, NONE), percent)
        if interval is not None:
            words = interval.words(f"{name} beside a busy process", f"{name} alone")
            found.append(f"{_percent(percent)}{words}")
    return found


def _percent(percent: float) -> str:
    return "" if percent == 50 else f"p{percent:g}: "


def _doubts(cells: Sequence[Cell]) -> list[str]:
    """What a reader should know before believing the rest."""
    rounds = min((len(cell.rounds) for cell in cells), default=0)
    said = [f"An interval of 99 % takes {LEAST_ROUNDS} rounds."] if rounds < LEAST_ROUNDS else []
    for rate in dict.fromkeys(str(cell.params["rate"]) for cell in cells):
        ours = [cell.figures for cell in cells if cell.measure == ONE_WAY and cell.params["rate"] == rate]
        late, sent = (sum(int(figures.get(name) or 0) for figures in ours) for name in ("late", "sent"))
        if late > _MUCH_LATE * sent:
            said.append(f"At {rate} {late / sent:.0%} of the messages left late: this machine cannot keep that pace.")
        said += _lost([cell for cell in cells if cell.measure == ONE_WAY and cell.params["rate"] == rate], rate)
    return said


def _lost(cells: Sequence[Cell], rate: str) -> list[str]:
    shares = {
        name: sum(cell.lost or 0 for cell in cells if cell.variant == name)
        / max(1, sum(int(cell.figures.get("sent") or 0) for cell in cells if cell.variant == name))
        for name in dict.fromkeys(cell.variant for cell in cells)
    }
    told = ", ".join(f"{share:.1%} of {name}" for name, share in shares.items() if share > _MUCH_LOST)
    return (
        [f"At {rate} messages were lost: {told}. Percentiles are of the others, aims count them as infinitely late."]
        if told
        else []
    )


def _with_lost(cell: Cell) -> Cell:
    """What never arrived is infinitely late; as much was sent in each round."""
    each = int(cell.figures.get("sent") or 0) // max(1, len(cell.rounds))
    return replace(cell, rounds=[[*one, *[math.inf] * (each - len(one))] for one in cell.rounds])


def _aims(ways: _Ways) -> list[str]:
    """The p50's is for the upper end of the interval, the p99's for the ratio: so the aims were set.

    Where too much of all that was sent never arrived the ratio does not help, even if that was in few rounds.
    """
    said = []
    without = _compared(ways, (P2P, NONE), (_better(ways, NONE, 50), NONE), 50)
    if without is not None:
        said.append(_aim(f"{P2P} / better MQTT, p50, upper end of the interval", without.high, AIM_P50, without))
    media = _compared(ways, (P2P, MEDIA), (_better(ways, MEDIA, 99), MEDIA), 99)
    if media is not None:
        value = media.ratio if math.isfinite(ways[P2P, MEDIA].percentile(99)) else math.inf
        said.append(_aim(f"{P2P} / better MQTT with media, p99", value, AIM_MEDIA_P99, media))
    return said


def _aim(what: str, value: float, aim: float, interval: Interval) -> str:
    """What cannot be told from equal is no aim met, however lucky its ratio."""
    if interval.few:
        outcome, why = "not judged", f" of {interval.rounds} rounds"
    elif math.isinf(value):
        outcome, why = "missed", ", too much was lost"
    elif interval.equal:
        outcome, why = "missed", ", equal within noise"
    else:
        outcome, why = "met" if value <= aim else "missed", ""
    return f"aim: {what}, at most {aim:.2f}: {outcome} ({interval}{why})"
