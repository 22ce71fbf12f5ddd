"""The answers of /archive/ for one robot and two made-up days, without recordings: what the replay page needs to be seen.

Goob is recorded on 22 November 2026 from 10:00 to 10:05 and from 10:08:20 to 10:12 UTC. Between the two there was no
connection to the broker.
"""

from __future__ import annotations

import asyncio
import io
import json
import math
import struct
import time
import zlib
from collections.abc import Iterator
from typing import Any, NamedTuple

from PIL import Image
from starlette.requests import Request
from starlette.responses import JSONResponse, PlainTextResponse, Response
from starlette.routing import Route

from pebble.contract.packets import Codec, Picture, PictureKind, Sound
from pebble.media.speech import Speech
from tests.support import ROOT

ROBOT = "pebble/robots/goob"
DAY = "2026-11-22"
DAY_MS = 86_400_000
START = 1_795_305_600_000 + 36_000_000  # 10:00 UTC
GAP = (START + 300_000, START + 500_000)
END = START + 720_000
SESSIONS = [(START, GAP[0]), (GAP[1], END)]
STEP_MS = 10_000
PICTURE_MS, SOUND_MS = 100, 20
STATE, CHAIN, INCOMING, PICTURE, SOUND = 1, 2, 4, 8, 16


class Recorded(NamedTuple):
    """One message."""

    at: int
    flags: int
    metric: str
    payload: bytes


def framed(message: Recorded) -> bytes:
    """As /archive/segment sends it."""
    metric = message.metric.encode()
    head = struct.pack(">dBH", message.at, message.flags, len(metric))
    return struct.pack(">I", len(head) + len(metric) + len(message.payload)) + head + metric + message.payload


def _json(value: Any) -> bytes:
    return json.dumps(value).encode()


def _imu(at: int) -> dict[str, Any]:
    seconds = at / 1000
    value = {
        "gyro_dps": {"x": 2 * math.sin(seconds), "y": math.cos(2 * seconds), "z": 20 * math.sin(seconds / 5)},
        "orientation_deg": {"roll": 3 * math.sin(seconds / 7), "pitch": -2 * math.cos(seconds / 9)},
        "accel_norm_g": 1 + 0.05 * math.sin(3 * seconds),
    }
    return {"t": at, "seq": at // 200, "mcu_ms": at % 1_000_000, "value": value}


def _odometry(at: int) -> dict[str, Any]:
    angle = (at - START) / 8000
    value = {
        "x_mm": 800 * math.sin(angle),
        "y_mm": 500 * math.sin(2 * angle),
        "heading_rad": math.atan2(1000 * math.cos(2 * angle), 800 * math.cos(angle)),
        "distance_mm": (at - START) / 10,
    }
    return {"value": value, "unit": "mm", "source": "wheel-odometry", "timestamp": at / 1000}


def _log(at: int) -> dict[str, Any]:
    level = "WARNING" if at // 3000 % 9 == 0 else "INFO"
    return {"t": at, "level": level, "service": "mqtt_bridge", "message": f"line {(at - START) // 3000}"}


def _capabilities(_at: int) -> dict[str, Any]:
    value = {
        "transport": {"kind": "zenoh"},
        "video": {"available": True, "controls": True, "encodings": ["pbvz"]},
        "audio": {"available": True, "controls": True, "encodings": ["pcm"]},
        "drive": {"available": True, "controls": True},
    }
    return {"t": 0, "schema": "pebble-capabilities/v1", "value": value}


SQUARE = [[0.25, 0.25], [0.6, 0.25], [0.6, 0.7], [0.25, 0.7]]

#: Metric, ms between two messages, what they hold.
STREAMS = [
    ("online", 250, lambda at: {"t": at - 42}),
    ("capabilities", 60_000, _capabilities),
    ("charging-level", 5000, lambda at: {"value": 7.92 - (at - START) / 4e6, "unit": "v"}),
    ("charging-status", 20_000, lambda _at: {"value": False}),
    ("sensors/imu", 200, _imu),
    ("touch-sensors", 200, lambda at: {"value": {"a0": at // 200 % 900, "a1": 498, "a2": 730}, "unit": "adc"}),
    ("wheel-odometry", 200, _odometry),
    ("video-overlays", 100, lambda _at: {"source": "tags", "shapes": [SQUARE], "labels": []}),
    ("logs", 3000, _log),
]

_pictures: list[bytes] = []


def _jpeg(number: int) -> bytes:
    """The simulated world, seen by a camera that turns: another one for each number, fifty in all."""
    if not _pictures:
        whole = Image.open(ROOT / "docs" / "simulated-world.jpg")
        for index in range(50):
            target = io.BytesIO()
            whole.crop((4 * index, 60, 4 * index + 480, 330)).resize((480, 270)).save(target, "JPEG", quality=70)
            _pictures.append(target.getvalue())
    return _pictures[number % 50]


def _picture(at: int) -> bytes:
    number = (at - START) // PICTURE_MS
    return Picture(PictureKind.ZLIB_JPEG, number + 1, at - 40, zlib.compress(_jpeg(number))).pack()


def _sound(at: int) -> bytes:
    number = (at - START) // SOUND_MS
    piece = Speech(16_000).samples(320 * number, 320).tobytes()
    return Sound(Codec.PCM16LE, 1, 16_000, 320, number + 1, at - 30, piece).pack()


def _times(every: int, since: int, until: int) -> Iterator[int]:
    """Multiples of ``every`` in [since, until) at which something is recorded."""
    for begin, end in SESSIONS:
        first = max(begin, -(-max(since, begin) // every) * every)
        yield from range(first, min(until, end), every)


def messages(since: int, until: int, *, media: bool = True) -> list[Recorded]:
    """Everything received in [since, until), in order."""
    found = [Recorded(at, 0, metric, _json(make(at))) for metric, every, make in STREAMS for at in _times(every, since, until)]
    driven = range(START + 20_000, START + 50_000)
    found += [
        Recorded(at, INCOMING, "drive", _json({"x": 0.25, "z": 0.5 + 0.3 * math.sin(at / 1500)}))
        for at in _times(100, since, until)
        if at in driven
    ]
    found += [Recorded(at, INCOMING, "lights", _json({"r": 0, "g": 1, "b": 0})) for at in _times(30_000, since, until)]
    if media:
        found += [Recorded(at, PICTURE, "front-camera", _picture(at)) for at in _times(PICTURE_MS, since, until)]
        found += [Recorded(at, SOUND, "audio", _sound(at)) for at in _times(SOUND_MS, since, until)]
    return sorted(found, key=lambda message: message.at)


def state(at: int) -> list[Recorded]:
    """The newest value of each metric before ``at``, some log lines, and the pictures from the last key frame."""
    before: list[Recorded] = []
    for metric, every, make in STREAMS:
        count = 5 if metric == "logs" else 1
        times = [one for one in _times(every, at - max(10_000, 2 * every) - 200_000, at)][-count:]
        before += [Recorded(one, STATE, metric, _json(make(one))) for one in times]
    keyed = at // 500 * 500
    before += [
        Recorded(one, CHAIN | PICTURE, "front-camera", _picture(one)) for one in _times(PICTURE_MS, keyed, at + 1)
    ]
    return before


def _next(until: int) -> str:
    for begin, end in SESSIONS:
        if until < end:
            return str(max(until, begin))
    return ""


class ArchiveDouble:
    """Its routes; ``broken`` and ``slow_s`` are for tests of what a person is shown then."""

    def __init__(self) -> None:
        self.asked: list[str] = []
        self.broken = ""  # what every segment is answered with instead
        self.slow_s = 0.0
        self.indexing: list[float] = []  # shares, one for each question, before a day is there
        self.exports: dict[str, dict[str, Any]] = {}

    def routes(self) -> list[Route]:
        return [
            Route("/archive/days", self._days),
            Route("/archive/timeline", self._timeline),
            Route("/archive/segment", self._segment),
            Route("/archive/frame", self._frame),
            Route("/archive/strip", self._strip),
            Route("/archive/exports", self._begin, methods=["POST"]),
            Route("/archive/exports/{id}", self._progress),
            Route("/archive/exports/{id}/file", self._file),
            Route("/archive/exports/{id}/end", self._end, methods=["POST"]),
        ]

    async def _days(self, _request: Request) -> Response:
        fred = "pebble/robots/fred"
        today = {"day": DAY, "robots": [fred, ROBOT], "bytes": 1_234_567_890, "first": START, "last": END, "gaps": 1}
        first = today | {"day": "2026-11-21", "robots": [ROBOT], "bytes": 88_000_000, "gaps": 0}
        return JSONResponse([today, first | {"first": START - DAY_MS, "last": END - DAY_MS}])

    async def _timeline(self, request: Request) -> Response:
        if self.indexing:
            return JSONResponse({"indexing": self.indexing.pop(0)}, 202)
        if request.query_params["day"] != DAY:
            empty: list[Any] = []
            nothing = dict.fromkeys(("activity", "video", "audio", "rest", "gaps", "outages", "sessions"), empty)
            return JSONResponse({"from": START, "step": STEP_MS} | nothing)
        return JSONResponse(_day())

    async def _segment(self, request: Request) -> Response:
        query = request.query_params
        self.asked.append(str(request.url))
        if self.slow_s:
            await asyncio.sleep(self.slow_s)
        if self.broken:
            return PlainTextResponse(self.broken, 503)
        at, lasts = int(query["at"]), int(query["for"])
        found = state(at) if query.get("seek") else []
        found += messages(at, at + lasts, media=query.get("media") != "0")
        return Response(b"".join(map(framed, found)), headers={"x-next": _next(at + lasts), "x-complete": "1"})

    async def _frame(self, request: Request) -> Response:
        at = int(request.query_params["at"])
        last = list(_times(PICTURE_MS, at - 10_000, at + 1))[-1:]
        if not last:
            return PlainTextResponse("no picture was recorded then", 404)
        return Response(_jpeg((last[0] - START) // PICTURE_MS), media_type="image/jpeg")

    async def _strip(self, request: Request) -> Response:
        since, step, count, width = (int(request.query_params[name]) for name in ("since", "step", "count", "w"))
        strip = Image.new("RGB", (width * count, width * 9 // 16), (128, 128, 128))
        for index in range(count):
            at = since + index * step
            if last := list(_times(PICTURE_MS, at - 10_000, at + 1))[-1:]:
                picture = Image.open(io.BytesIO(_jpeg((last[0] - START) // PICTURE_MS)))
                strip.paste(picture.resize((width, width * 9 // 16)), (index * width, 0))
        target = io.BytesIO()
        strip.save(target, "JPEG")
        return Response(target.getvalue(), media_type="image/jpeg")

    async def _begin(self, request: Request) -> Response:
        wanted = await request.json()
        if any(one["state"] == "running" for one in self.exports.values()):
            return PlainTextResponse("another export is running: wait for it, or end it", 409)
        number = str(len(self.exports) + 1)
        self.exports[number] = wanted | {"state": "running", "begun": time.monotonic()}
        return JSONResponse({"id": number}, 202)

    async def _progress(self, request: Request) -> Response:
        one = self.exports[request.path_params["id"]]
        done = min(1.0, (time.monotonic() - one["begun"]) / 1.2)
        one["state"] = "ready" if done == 1.0 and one["state"] == "running" else one["state"]
        name = f"goob-{one['since']}.{one['as']}"
        return JSONResponse({"state": one["state"], "done": done, "why": "", "name": name, "bytes": 1_234_567})

    async def _file(self, request: Request) -> Response:
        headers = {"content-disposition": "attachment"}
        return Response(request.path_params["id"].encode(), media_type="application/octet-stream", headers=headers)

    async def _end(self, request: Request) -> Response:
        self.exports[request.path_params["id"]]["state"] = "ended"
        return JSONResponse({})


def _day() -> dict[str, Any]:
    """The timeline of the day, with an hour of being online around what is recorded to be played."""
    first = START - 3_600_000
    count = 7_200_000 // STEP_MS
    activity, video, audio, rest = ([0] * count for _ in range(4))
    for index in range(count):
        at = first + index * STEP_MS
        recorded = any(begin <= at < end for begin, end in SESSIONS)
        quiet = at < START - 60_000 and index % 40 != 0
        activity[index] = (1 if recorded or quiet else 0) | (64 | 128 if recorded else 0)
        activity[index] |= 2 if START + 20_000 <= at < START + 50_000 else 0
        activity[index] |= 16 if START + 520_000 <= at < START + 640_000 else 0
        activity[index] |= 32 if recorded and index % 9 == 0 else 0
        video[index] = round(200 + 60 * math.sin(index)) if recorded else 0
        audio[index] = 256 if recorded else 0
        rest[index] = 12 if activity[index] & 1 else 0
    return {
        "from": first,
        "step": STEP_MS,
        "activity": activity,
        "video": video,
        "audio": audio,
        "rest": rest,
        "gaps": [{"since": GAP[0], "until": GAP[1], "why": "no connection to the broker"}],
        "outages": [{"since": START - 1_400_000, "until": START - 1_100_000}],
        "sessions": [{"since": begin, "until": end} for begin, end in SESSIONS],
    }
