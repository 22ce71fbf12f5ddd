"""The paper's section 4.1 with simulated robots: their traffic is recorded, and analysed as by ``pebble analyse``."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from rich.console import Console

from pebble.bench import output
from pebble.bench.results import Stopwatch
from pebble.bench.traffic_report import assess, cells_of, tables
from pebble.errors import PebbleError
from pebble.recordings.library import FOREVER_NS
from pebble.recordings.traffic.results import Traffic
from pebble.rig.testbed import ROBOTS


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """Seconds of each part of the recording, and where the results go."""

    idle_s: float = 40.0
    session_s: float = 80.0
    quick: bool = False
    output: Path = output.FOLDER


def plan(*, quick: bool = False, output: Path = output.FOLDER) -> Plan:
    return Plan(quick=True, idle_s=7.0, session_s=6.0, output=output) if quick else Plan(output=output)


def run(plan: Plan, console: Console | None = None) -> int:
    """Records, analyses, prints and writes; returns 0. Raises PebbleError, also without the extra ``archive``."""
    console = console or Console()
    if find_spec("duckdb") is None:
        raise PebbleError('left out: the analysis of recordings needs DuckDB: pip install "pebble-robot[archive]"')
    output.check_folder(plan.output)
    command = ["pebble", "bench", "traffic", *(["--quick"] if plan.quick else [])]
    watch = Stopwatch("traffic", command, {"idle_s": plan.idle_s, "session_s": plan.session_s, "robots": list(ROBOTS)})
    traffic = measure(plan)
    for table in tables(traffic):
        console.print(table)
    results = watch.results(cells_of(traffic), assess(traffic), quick=plan.quick)
    output.finish(results, plan.output, console)
    return 0


def measure(plan: Plan) -> Traffic:
    """The analysis of a recording that is made now. Raises PebbleError."""
    from pebble.bench.traffic_stage import record
    from pebble.recordings.traffic.analysis import analyse
    from pebble.recordings.traffic.sources import sources

    with tempfile.TemporaryDirectory(prefix="pebble-traffic-") as name:
        folder, scratch = Path(name) / "stage", Path(name) / "scratch"
        record(folder, plan.idle_s, plan.session_s)
        scratch.mkdir()
        found = sources([folder / "recordings"], scratch, since_ns=0, until_ns=FOREVER_NS)
        return analyse(found, scratch)
