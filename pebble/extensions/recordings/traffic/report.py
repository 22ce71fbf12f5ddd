"""The report of an analysis: a single HTML file, and its tables as CSV."""

from collections.abc import Callable, Iterable
from html import escape
from pathlib import Path
from typing import Final

from pebble.errors import PebbleError
from pebble.extensions.recordings.traffic.figures import Figure, figures
from pebble.extensions.recordings.traffic.results import COMPONENT, RobotTraffic, Traffic
from pebble.extensions.recordings.traffic.tables import Table, media_bandwidth, moment, tables, write_csv
from pebble.version import __version__

NAME: Final = "traffic.html"

_STYLE: Final = """
body { font: 16px/1.5 system-ui, sans-serif; color: #1a1a1a; background: #fff }
body { max-width: 76rem; margin: 0 auto; padding: 1.5rem }
h1 { margin: 0 } h2 { margin: 2.5rem 0 .5rem; border-bottom: 1px solid #ccc } p, li, dd { max-width: 48rem }
nav a { margin-right: 1rem } a { color: #0b5a8a } small, figcaption { color: #444 }
.figures { display: grid; grid-template-columns: repeat(auto-fit, minmax(21rem, 1fr)); gap: 1rem }
figure { margin: 0; padding: .75rem; border: 1px solid #ddd; border-radius: .5rem }
figure svg { width: 100%; height: auto }
figcaption { font-size: .85rem } figcaption b { color: #1a1a1a; display: block }
.scroll { overflow-x: auto } table { border-collapse: collapse; font-size: .85rem; font-variant-numeric: tabular-nums }
th, td { padding: .2rem .6rem; border-bottom: 1px solid #ddd; text-align: right; white-space: nowrap }
th { vertical-align: bottom; background: #f4f4f4 } .text { text-align: left }
tbody tr:nth-child(even) { background: #fafafa }
.remarks { background: #fff6e0; border-left: 4px solid #E69F00; padding: .5rem 1rem .5rem 2rem }
@media print { figure, tr { break-inside: avoid } }
"""
_DEFINITIONS: Final = (
    (
        "active second",
        "A second in which at least one message of that kind came. Medians and 95th percentiles (p95) are over active "
        "seconds, as in the paper's Table 4.1; both interpolate linearly.",
    ),
    (
        "session, idle",
        "In a session a robot was driven, watched, played a sound or ran a script, with breaks of at most two minutes; "
        "five seconds before and after belong to it. Idle is the rest of the time in which heartbeats came.",
    ),
    (
        "outage",
        "An interval between two heartbeats of more than 1.5 times the usual one; its length is what it was longer "
        "than usual. Above 60 s a robot counts as offline. Times in which nothing was recorded are left out.",
    ),
)


def write_report(
    traffic: Traffic,
    folder: Path,
    *,
    csv: bool = False,
    advance: Callable[[str, float], None] = lambda _what, _share: None,
) -> list[Path]:
    """Write ``traffic.html``, and with ``csv`` each table; return the files. Raises PebbleError."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        page = folder / NAME
        page.write_text(_page(traffic, advance), encoding="utf-8")
        csv_files = [write_csv(table, folder) for table in tables(traffic)] if csv else []
        return [page, *csv_files]
    except OSError as error:
        raise PebbleError(f"{folder}: {error.strerror}") from None


def remarks(traffic: Traffic) -> list[str]:
    """Return remarks about unusual facts, a sentence each."""
    sentences = []
    if traffic.gaps:
        sentences.append(f"Nothing was recorded {_times(len(traffic.gaps))}; these times are left out of outages.")
    if traffic.dropped or traffic.missing:
        sentences.append(
            f"{traffic.dropped} messages were not recorded for lack of room or speed, "
            f"and {traffic.missing} were lost to damage of recordings."
        )
    return sentences + [f"Not all could be read of {line}." for line in traffic.unread]


def _page(traffic: Traffic, advance: Callable[[str, float], None]) -> str:
    body = [*_head(traffic)]
    for number, robot in enumerate(traffic.robots):
        advance(f"draw {robot.robot}", number / len(traffic.robots))
        body += _robot(robot, number)
    body.append('<h2 id="words">Words</h2><dl>')
    body += [f"<dt><b>{escape(word)}</b></dt><dd>{escape(meaning)}</dd>" for word, meaning in _DEFINITIONS]
    body.append("</dl>")
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8"><title>Robot traffic</title>'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        "<meta http-equiv=\"Content-Security-Policy\" content=\"default-src 'none'; style-src 'unsafe-inline'\">"
        f"<style>{_STYLE}</style></head><body>{''.join(body)}</body></html>\n"
    )


def _head(traffic: Traffic) -> Iterable[str]:
    messages, size = sum(robot.messages for robot in traffic.robots), sum(robot.bytes for robot in traffic.robots)
    yield "<h1>Robot traffic</h1>"
    yield (
        f"<p>{moment(traffic.since_ns // 10**9)} to {moment(traffic.until_ns // 10**9)}: {len(traffic.robots)} robots "
        f"and components, {messages:,} messages, {size / 1e6:,.1f} MB of payload, from {traffic.recordings} "
        f"recordings. Times are UTC. Bandwidths are of payloads, without headers. The figures are those of section "
        f"4.1 of the paper, for every robot. <small>Pebble {escape(__version__)}</small></p>"
    )
    links = [f'<a href="#robot-{number}">{escape(_id(robot))}</a>' for number, robot in enumerate(traffic.robots)]
    yield f'<nav>{" ".join(links)} <a href="#words">words</a></nav>'
    sentences = remarks(traffic)
    if sentences:
        items = "".join(f"<li>{escape(remark)}</li>" for remark in sentences)
        yield f'<h2>What stands out</h2><ul class="remarks">{items}</ul>'
    table = media_bandwidth(traffic)
    if table.rows:
        yield _table(table)
        yield (
            "<p><small>Seconds without video, or without audio, do not count. One channel of uncompressed sound at "
            "16 kHz takes 265.6 kbit/s: 50 packets of 664 bytes a second.</small></p>"
        )


def _robot(robot: RobotTraffic, number: int) -> Iterable[str]:
    yield f'<h2 id="robot-{number}">{escape(_id(robot))}</h2><p>{escape(_about(robot))}</p><div class="figures">'
    yield from (_figure(figure, robot) for figure in figures(robot))
    yield "</div>"


def _about(robot: RobotTraffic) -> str:
    kind = "a component without heartbeats" if robot.machine == COMPONENT else f"{robot.machine} robot"
    return f"{robot.robot}, {kind}: {robot.messages:,} messages, {len(robot.sessions)} sessions."


def _figure(figure: Figure, robot: RobotTraffic) -> str:
    label = escape(f"{figure.title} of {_id(robot)}")
    svg = figure.svg.replace("<svg", f'<svg role="img" aria-label="{label}"', 1)
    return (
        f"<figure>{svg}<figcaption><b>{escape(figure.number)}: {escape(figure.title)}</b>{escape(figure.caption)}"
        "</figcaption></figure>"
    )


def _table(table: Table) -> str:
    heads = "".join(f"<th{_class(column)}>{escape(title)}</th>" for column, (_, title) in enumerate(table.columns))
    rows = []
    for row in table.rows:
        cells = "".join(f"<td{_class(column)}>{_formatted(value)}</td>" for column, value in enumerate(row))
        rows.append(f"<tr>{cells}</tr>")
    return (
        f'<h2>{escape(table.title)}</h2><div class="scroll"><table><thead><tr>{heads}</tr></thead>'
        f"<tbody>{''.join(rows)}</tbody></table></div>"
    )


def _class(column: int) -> str:
    """Return the attribute for cells of a column: the first one holds text."""
    return "" if column else ' class="text"'


def _formatted(value: str | float | None) -> str:
    if isinstance(value, str):
        return escape(value)
    return "–" if value is None else f"{value:,.2f}"


def _id(robot: RobotTraffic) -> str:
    return robot.robot.rpartition("/")[2]


def _times(number: int) -> str:
    return "once" if number == 1 else f"{number:,} times"
