"""The server between one robot's camera and the pages that show it."""

from __future__ import annotations

import asyncio
import time

import cv2
import numpy as np
import pytest

from pebble.extensions.media.decode import VideoDecoder
from pebble.extensions.operator.client.media_request.queue import NO_FRAME
from pebble.extensions.page.media import rescue
from tests.ext.page.media.robots import (
    EVERYTHING,
    REF,
    VIDEO,
    PicturePage,
    PictureRobot,
    Server,
    serving,
    until,
)
from tests.kit.scene import read_counter

pytestmark = pytest.mark.anyio
PLAIN = EVERYTHING - {"h264"}


@pytest.fixture
def robot() -> PictureRobot:
    return PictureRobot()


# -- forwarding


def decoded(bodies: list[bytes]) -> list[int | None]:
    decoder = VideoDecoder()
    shown = [decoder.feed(body) for body in bodies]
    return [None if one is None else read_counter(one.picture) for one in shown]


@pytest.mark.parametrize("can", [EVERYTHING, frozenset({"json"}), frozenset({"pbvd"})])
async def test_payloads_arrive_unchanged_and_decodable(
    robot: PictureRobot, server: Server, can: frozenset[str]
) -> None:
    page = server.open(PicturePage(), can)
    await until(lambda: len(page.frames) > 20)
    bodies = page.direct()
    assert set(bodies) <= set(robot.sent)
    assert None not in decoded(bodies)
    assert [seq for seq, _, _ in page.frames] == sorted({seq for seq, _, _ in page.frames})


async def test_a_page_that_wants_a_key_frame_gets_one(robot: PictureRobot, server: Server) -> None:
    page = server.open(PicturePage())
    await until(lambda: len(page.frames) > 5)
    await asyncio.sleep(1.0)  # one is requested once a second
    count = len(page.frames)
    page.acknowledge(NO_FRAME, 1)
    await until(lambda: any(request.get("keyframe") for request in robot.requests))
    await until(lambda: len(page.frames) > count + 3)


# -- rescue


@pytest.mark.parametrize("encoding", ["h264", "pbvd", "json"])
async def test_a_page_that_decodes_nothing_gets_jpegs(encoding: str) -> None:
    robot = PictureRobot({**VIDEO, "encodings": [encoding], "encoding": encoding}, fps=20)
    async with serving(robot) as server:
        page, start = server.open(PicturePage(), frozenset()), 0.0
        await until(lambda: page.rescued())
        start, count = time.monotonic(), len(page.frames)
        await asyncio.sleep(2)
        rate = (len(page.frames) - count) / (time.monotonic() - start)
        assert 0.5 < rate <= 5.5
        assert page.direct() == []
        pictures = [cv2.imdecode(np.frombuffer(body, np.uint8), cv2.IMREAD_COLOR) for body in page.rescued()]
        numbers = [read_counter(picture) for picture in pictures]
        assert numbers == sorted(number for number in numbers if number is not None)
        assert numbers[-1] >= len(robot.sent) - 40
        captured = int.from_bytes(page.frames[-1][2][:8], "big")
        assert 0 <= time.time() * 1000 - captured < 5000


async def test_without_pyav_there_is_a_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rescue.pyav, "installed", lambda: False)
    robot = PictureRobot({**VIDEO, "encodings": ["h264"]})
    async with serving(robot) as server:
        page = server.open(PicturePage(), PLAIN)
        await until(lambda: server.view and server.view.state == "flowing" and "needs PyAV" in server.view.why)
        assert "1 of 1 browsers cannot show it" in server.view.why
        assert page.frames == []


async def test_a_still_is_the_newest_key_frame_and_the_last_one_of_a_camera_that_rests(
    robot: PictureRobot, server: Server
) -> None:
    assert await server.media.snapshot(REF) is None
    assert await server.media.snapshot("#") is None
    assert robot.published == []
    page = server.open(PicturePage())
    await until(lambda: len(page.frames) > 30)
    stills = await asyncio.gather(*(server.media.snapshot(REF) for _ in range(10)))
    assert len({still and still[0] for still in stills}) == 1
    picture = cv2.imdecode(np.frombuffer(stills[0][0] if stills[0] else b"", np.uint8), cv2.IMREAD_COLOR)
    assert len(robot.sent) - 70 <= (read_counter(picture) or 0) <= len(robot.sent)
    robot.mute = True
    await until(lambda: server.view.state == "silent")
    assert await server.media.snapshot(REF) is not None
