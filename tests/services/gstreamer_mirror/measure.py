"""Measures what the mirror costs, beside GStreamer's own ``shmsink``: ``python -m tests.….measure [ROUNDS]``.

Both serve the same frames to Debian's ``shmsrc``, in turns. Printed are processor time of all processes that serve, and
how old a picture is when this process has read it.
"""

# ruff: noqa: T201  (a program)

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from pebble.rig.processes import children
from pebble.transports.frames import FrameInfo, FrameReader
from tests.services.gstreamer_mirror.mirror_rig import picture_reader
from tests.services.media_rig import Device
from tests.support import ROOT, Broker, Child, until

SECONDS, FPS, SIZE = 10.0, 30, (640, 480)
_TICK = os.sysconf("SC_CLK_TCK")


class Stamped(Device):
    """A camera whose pictures carry their time in the first eight bytes."""

    def __init__(self, folder: Path) -> None:
        self._picture = np.random.default_rng(1).integers(0, 255, 3 * SIZE[0] * SIZE[1], np.uint8)
        super().__init__(folder, "camera", FPS, self._picture.size)

    def write(self, number: int) -> None:
        now = time.monotonic_ns()
        self._picture[:8] = np.frombuffer(now.to_bytes(8, "little"), np.uint8)
        self.writer.write(self._picture, FrameInfo(captured_ns=now, format="bgr24", width=SIZE[0], height=SIZE[1]))


@contextmanager
def ours(folder: Path, port: int, path: Path) -> Iterator[list[int]]:
    config = folder / "robot.json"
    config.write_text(json.dumps({
        "robot": {"id": "measured"}, "local_mqtt": {"port": port},
        "transport": {"kind": "mqtt", "run_dir": str(folder / "run"), "state_dir": str(folder / "state")},
        "services": {"av_daemon": {"enabled": True, "video": {"socket_path": str(path)}}},
    }))  # fmt: skip
    with _running([sys.executable, "-m", "pebble.services.gstreamer_mirror", str(config)]) as process:
        yield [process.pid]


@contextmanager
def gstreamers(folder: Path, _port: int, path: Path) -> Iterator[list[int]]:
    with _running([sys.executable, "-m", __spec__.name, "--pipe", str(folder / "run"), str(path)]) as process:
        assert until(lambda: children(process.pid))
        yield [process.pid, *children(process.pid)]


@contextmanager
def _running(command: list[str]) -> Iterator[Child]:
    process = Child(command, cwd=ROOT, stderr=subprocess.DEVNULL)
    try:
        yield process
    finally:
        process.terminate()
        process.wait(10)


def pipe(run_dir: str, path: str) -> None:
    """Feed GStreamer's own writer."""
    parse = ["rawvideoparse", "format=bgr", f"width={SIZE[0]}", f"height={SIZE[1]}", f"framerate={FPS}/1"]
    sink = ["shmsink", f"socket-path={path}", f"shm-size={16 << 20}", "wait-for-connection=false", "sync=false"]
    command = ["gst-launch-1.0", "-q", "fdsrc", "fd=0", "!", *parse, "!", *sink]
    writer = Child(command, stdin=subprocess.PIPE)
    assert writer.stdin is not None
    with FrameReader(Path(run_dir), "camera", views=True) as frames:
        for frame in frames:
            writer.stdin.write(memoryview(np.ascontiguousarray(frame.picture().reshape(-1))))
            writer.stdin.flush()
            frame.release()


def seconds_of(pid: int) -> float:
    """The processor time that a process has used."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / _TICK


def measured(path: Path, pids: list[int]) -> tuple[float, list[float]]:
    """Share of a processor, and the ages of pictures in ms."""
    assert until(path.exists, 20)
    time.sleep(0.5)
    with picture_reader(path, *SIZE, FPS) as reader:
        assert reader.gets(FPS, 20)
        before, began = sum(map(seconds_of, pids)), time.monotonic()
        first = len(reader.frames)
        ages = []
        for number in range(first, first + int(SECONDS * FPS)):
            if not until(lambda number=number: len(reader.frames) > number, 5, step=0.0005):
                break
            ages.append((time.monotonic_ns() - int.from_bytes(reader.frames[number][:8], "little")) / 1e6)
        return (sum(map(seconds_of, pids)) - before) / (time.monotonic() - began), ages


def main(rounds: int) -> None:
    found: dict[str, list[tuple[float, list[float]]]] = {"ours": [], "gstreamer's": []}
    with tempfile.TemporaryDirectory(prefix="pblm") as name:
        folder = Path(name)
        (folder / "run").mkdir(mode=0o700)
        broker = Broker(folder)
        with Stamped(folder / "run"):
            for number in range(rounds):
                for side, serve in (("ours", ours), ("gstreamer's", gstreamers)):
                    path = folder / f"{number}-{side[0]}.sock"
                    with serve(folder, broker.port, path) as pids:
                        found[side].append(measured(path, pids))
        broker.stop()
    for side, results in found.items():
        ages = sorted(age for _, some in results for age in some)
        p95 = ages[int(0.95 * len(ages))]
        cpu = statistics.median(share for share, _ in results)
        print(f"{side}: {100 * cpu:.1f} % of a processor, {statistics.median(ages):.2f} ms, 95 % {p95:.2f} ms")
    ratio = [a / b for (a, _), (b, _) in zip(found["ours"], found["gstreamer's"], strict=True)]
    print(
        f"processor time, ours / gstreamer's: {', '.join(f'{one:.2f}' for one in ratio)}; load {os.getloadavg()[0]:.1f}"
    )


if __name__ == "__main__":
    if sys.argv[1:2] == ["--pipe"]:
        pipe(*sys.argv[2:])
    else:
        main(int(sys.argv[1]) if sys.argv[1:] else 3)
