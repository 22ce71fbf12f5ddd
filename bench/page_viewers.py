"""Viewers of one robot without a browser, as a process: ``python -m pebble.bench.page_viewers URL REF COUNT SECONDS``.

Each acknowledges every picture at once, as a fast page does. Prints one line of JSON: when it began to count and
stopped (time.monotonic()), and the pictures of each viewer between.
"""

from __future__ import annotations

import asyncio
import struct
import sys
import time
from typing import Any
from urllib.parse import urlencode, urlsplit

from websockets.asyncio.client import connect

from pebble.rig.worker_end import answer

_CAN = "h264,pbvz,pbvd,json,jpeg"
_FLOW_S = 4.0  # until the camera is running and every viewer has a key frame


async def watch(url: str, ref: str, arrived: list[float]) -> None:
    """Receive and acknowledge until cancelled."""
    host = urlsplit(url).netloc
    address = f"ws://{host}/ws/media?{urlencode({'ref': ref, 'can': _CAN})}"
    async with connect(address, origin=f"http://{host}", compression=None, max_size=None) as socket:  # type: ignore[arg-type]
        async for message in socket:
            arrived.append(time.monotonic())
            await socket.send(message[:4] + struct.pack(">B", 0))  # type: ignore[operator]


async def measure(url: str, ref: str, count: int, seconds: float) -> dict[str, Any]:
    arrived: list[list[float]] = [[] for _ in range(count)]
    tasks = [asyncio.create_task(watch(url, ref, one)) for one in arrived]
    await asyncio.sleep(_FLOW_S)
    began = time.monotonic()
    await asyncio.sleep(seconds)
    ended = time.monotonic()
    await asyncio.sleep(0.2)  # what is under way
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)
    frames = [sum(began <= at < ended for at in one) for one in arrived]
    return {"began": began, "ended": ended, "frames": frames}


def main(arguments: list[str]) -> int:
    url, ref, count, seconds = arguments
    answer(asyncio.run(measure(url, ref, int(count), float(seconds))))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
