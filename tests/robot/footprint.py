"""What a robot costs and how fast it is, both transports side by side: ``make footprint``.

Real processes, stock mosquitto brokers, loopback, a simulated MCU on a pty. Each figure is the median of several runs
unless said otherwise; the machine's noise is in them.
"""

from __future__ import annotations

import os
import statistics
import sys
import time
from pathlib import Path

from rich.console import Console
from rich.table import Table

from tests.robot.operator import Operator, numbered
from tests.robot.rig import BASE, STOP, Rig
from tests.support import until

LAUNCHES, IDLE_S, COMMANDS, RATE_HZ = 5, 10.0, 500, 20.0


DEVICES = {
    "enabled": True,
    "video": {"backend": "synthetic", "width": 640, "height": 480, "fps": 15},
    "audio": {"source": "synthetic"},
}


def main() -> int:
    table = Table("figure", "mqtt", "zenoh", title=f"{os.cpu_count()} cores, Python {sys.version.split()[0]}")
    columns = [measure(kind) | measure_media(kind) for kind in ("mqtt", "zenoh")]
    for name in dict.fromkeys(name for column in columns for name in column):
        table.add_row(name, *(column.get(name, "–") for column in columns))
    Console(width=100).print(table)
    return 0


def measure(kind: str) -> dict[str, str]:
    launches = [_launch(kind) for _ in range(LAUNCHES)]
    with Rig(kind, direct=True) as rig:
        time.sleep(3)  # start-up work is over
        latencies, floor = _latencies(rig)
        time.sleep(1)
        processes = {"launcher": rig.launcher_pid, **rig.processes()}
        cpu = _cpu_percent(list(processes.values()))
        pss = {name: _pss_mb(pid) for name, pid in processes.items()}
        threads = {name: _threads(pid) for name, pid in processes.items()}
    return {
        f"launch to first heartbeat, s (median of {LAUNCHES})": f"{statistics.median(launches):.2f}",
        "processes": str(len(processes)),
        "threads": str(sum(threads.values())),
        "PSS, sum, MB": f"{sum(pss.values()):.1f}",
        "PSS, mean per process, MB": f"{statistics.mean(pss.values()):.1f}",
        **{f"  {name}, MB (threads)": f"{pss[name]:.1f} ({threads[name]})" for name in processes},
        f"CPU idle, % of one core over {IDLE_S:.0f} s": f"{cpu:.1f}",
        f"drive command, operator to pty, n={len(latencies)}: p50 / p99 / max, ms": _spread(latencies),
        "  the same messages, operator to a stock client of that broker, ms": _spread(floor),
        "  ratio of the medians": f"{statistics.median(latencies) / statistics.median(floor):.1f}",
    }


def measure_media(kind: str) -> dict[str, str]:
    """The same robot with pictures (640x480, 15 per second, json) and sound (PCM) going to an operator."""
    with Rig(kind, direct=True, av_daemon=DEVICES) as rig:
        for flag, ask in (("mqtt-video", "front-camera"), ("mqtt-audio", "audio")):
            rig.operator.send(f"incoming/flags/{flag}", True, retain=True)
            rig.operator.send(f"incoming/{ask}", True)
        until(lambda: len(rig.operator.on("outgoing/front-camera")) > 45, 20)
        processes = {"launcher": rig.launcher_pid, **rig.processes()}
        began = time.monotonic()
        cpu = _cpu_percent(list(processes.values()))
        fps = len(rig.operator.on("outgoing/front-camera", began)) / (time.monotonic() - began)
        pss = {name: _pss_mb(pid) for name, pid in processes.items()}
    return {
        "with pictures and sound: processes": str(len(processes)),
        "  PSS, sum, MB": f"{sum(pss.values()):.1f}",
        **{f"    {name}, MB": f"{pss[name]:.1f}" for name in processes},
        "  CPU, % of one core": f"{cpu:.1f}",
        "  frames delivered per second": f"{fps:.2f}",
        "  CPU per delivered frame, ms": f"{10 * cpu / fps:.1f}" if fps else "–",
    }


def _spread(figures: list[float]) -> str:
    ordered = sorted(figures)
    return f"{statistics.median(ordered):.2f} / {ordered[int(len(ordered) * 0.99)]:.2f} / {ordered[-1]:.2f}"


def _launch(kind: str) -> float:
    with Rig(kind, start=False, direct=True) as rig:
        began = rig.start(ready=False)
        return rig.operator.wait_for("outgoing/online").at - began


def _latencies(rig: Rig) -> tuple[list[float], list[float]]:
    """Milliseconds from the operator's publish call to the line at the pty, for every command of a drive.

    And to a plain paho client that listens to the same broker: what one hop costs on this machine with no robot in it.
    """
    driver, began = Operator(rig.remote.port, "nobody/listens/here"), time.monotonic()
    driver.base = BASE
    sent: list[tuple[float, float]] = []
    for number in range(1, COMMANDS + 1):
        sent.append((time.monotonic(), round(0.1 + number / 1000, 3)))
        driver.send("incoming/drive-values", numbered(number))
        time.sleep(1 / RATE_HZ)
    until(lambda: not rig.mcu.moving(began), 3)
    arrived = {wheels[0]: at for at, wheels in rig.mcu.drives(began) if wheels != STOP}
    driver.close()
    heard = [seen.at for seen in rig.operator.on("incoming/drive-values", began)]
    floor = [1000 * (there - at) for (at, _), there in zip(sent, heard, strict=True)]
    return [1000 * (arrived[left] - at) for at, left in sent if left in arrived], floor


def _cpu_percent(pids: list[int]) -> float:
    before, began = _cpu_s(pids), time.monotonic()
    time.sleep(IDLE_S)
    return 100 * (_cpu_s(pids) - before) / (time.monotonic() - began)


def _cpu_s(pids: list[int]) -> float:
    ticks = sum(sum(map(int, Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[11:13])) for pid in pids)
    return ticks / os.sysconf("SC_CLK_TCK")


def _pss_mb(pid: int) -> float:
    lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("Pss:")) / 1024


def _threads(pid: int) -> int:
    return len(list(Path(f"/proc/{pid}/task").iterdir()))


if __name__ == "__main__":
    sys.exit(main())
