"""Four robots, a tab each, for an hour: is memory flat, and does no page complain? ``python -m tests.web.page_soak``.

Each tab shows a robot with all its cards and plays its sound; one after another drives. Once a minute: memory of the
server's process, of each tab's script after its garbage was collected, and of Chromium's processes of pages, where
their workers and pictures are. The last quarter of the time is compared with the second one, in which everything has
been loaded and all buffers of the pages are filling or full.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

from playwright.sync_api import CDPSession
from rich.console import Console as Terminal
from rich.table import Table

from pebble.bench.usage import pss_mb
from pebble.rig.testbed import ROBOTS
from tests.support import quarters
from tests.web import rig
from tests.web.browser import Tab
from tests.web.console import Console, console
from tests.web.stage import Stage

CHANGE = 0.10  # at most, of memory
_PERIOD_S = 60.0
_DRIVE_MS = 400

Samples = dict[str, list[float]]  # MB, by what was measured


@contextmanager
def pages() -> Iterator[tuple[Stage, CDPSession, list[Console]]]:
    """A page of each robot, with every card open and its sound on."""
    with Stage() as stage, rig.chromium() as browser, ExitStack() as stack:
        opened = [stack.enter_context(console(browser, stage, name)) for name in ROBOTS]
        for one in opened:
            assert one.tab.until(lambda one=one: one.state("capabilities") is not None, 30), one.name  # type: ignore[misc]
            one.page.wait_for_timeout(2000)
            closed = one.page.locator(".card [aria-expanded=false]").first  # cards, and the lines of values
            while closed.count():
                closed.click()
            listen = one.test("listen")
            if listen.count() and listen.is_enabled():
                listen.click()
        yield stage, browser.new_browser_cdp_session(), opened


def measure(stage: Stage, browser: CDPSession, opened: list[Console], samples: Samples) -> None:
    """Append the memory of now."""
    samples.setdefault("server", []).append(pss_mb(stage.server.pid))
    for one in opened:
        for what, value in memory(one.tab).items():
            samples.setdefault(f"{one.name}: {what}", []).append(value)
    processes = browser.send("SystemInfo.getProcessInfo")["processInfo"]
    samples.setdefault("all tabs", []).append(sum(pss_mb(one["id"]) for one in processes if one["type"] == "renderer"))


def memory(tab: Tab) -> dict[str, float]:
    """The size of a tab without what nothing refers to: its script's heap in MB, its nodes and its listeners."""
    session = tab.cdp()
    session.send("HeapProfiler.enable")
    session.send("HeapProfiler.collectGarbage")
    session.send("Performance.enable")
    values = {one["name"]: one["value"] for one in session.send("Performance.getMetrics")["metrics"]}
    session.detach()
    return {"heap": values["JSHeapUsedSize"] / 2**20, "nodes": values["Nodes"], "listeners": values["JSEventListeners"]}


def drive(one: Console) -> bool:
    """Whether the robot moved for a key, and stopped."""
    try:
        one.take()
        moved = one.drive()
        one.page.wait_for_timeout(_DRIVE_MS)
    finally:
        one.let_go()
    return moved and one.rests()


def _is_memory(what: str) -> bool:
    return not what.endswith(("nodes", "listeners"))


def change(values: list[float]) -> float:
    """The growth of the median of the last quarter since the second one; 0: none."""
    _, before, _, after = quarters(values)
    return after / before - 1


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.web.page_soak", description=__doc__)
    parser.add_argument("--minutes", type=float, default=60.0)
    minutes = parser.parse_args().minutes
    terminal, samples, drives = Terminal(), dict[str, list[float]](), list[bool]()
    with pages() as (stage, browser, opened):
        began = time.monotonic()
        while (passed := time.monotonic() - began) < 60 * minutes:
            drives.append(drive(opened[len(drives) % len(opened)]))
            measure(stage, browser, opened, samples)
            newest = ", ".join(f"{what} {values[-1]:.1f}" for what, values in samples.items() if _is_memory(what))
            terminal.print(f"{passed / 60:5.1f} min, MB: {newest}", highlight=False)
            opened[0].page.wait_for_timeout(max(0.0, 1000 * (_PERIOD_S * len(drives) - (time.monotonic() - began))))
        complaints = [f"{one.name}: {text}" for one in opened for text in (*one.tab.complaints(), *one.tab.console)]
    table = Table("what", "first", "lowest", "highest", "last", "change", title=f"{minutes:.0f} minutes")
    for what, values in samples.items():
        figures = (values[0], min(values), max(values), values[-1])
        table.add_row(what, *(f"{value:.1f}" for value in figures), f"{100 * change(values):+.1f} %")
    terminal.print(table)
    grown = [what for what, values in samples.items() if abs(change(values)) > CHANGE]
    for problem in (*(f"not flat: {what}" for what in grown), *complaints):
        terminal.print(problem, markup=False)
    terminal.print(
        f"{sum(drives)} of {len(drives)} drives moved their robot and ended; {len(complaints)} console messages"
    )
    return 1 if grown or complaints or not all(drives) else 0


if __name__ == "__main__":
    sys.exit(main())
