"""The server between one robot's camera and the pages that show it, and the requests for pictures and sound."""

from __future__ import annotations

import asyncio
import time
from typing import Any

import cv2
import numpy as np
import pytest

from pebble.extensions.media.decode import VideoDecoder
from pebble.extensions.page.media import rescue
from tests.ext.page.media.robots import EVERYTHING, REF, VIDEO, PicturePage, PictureRobot, Server, serving, until
from tests.kit.scene import read_counter

pytestmark = pytest.mark.anyio
#: Of another robot; test_robot_commands has more topics that capabilities may not name.
FOREIGN = {"topic": "pebble/robots/victim/outgoing/front-camera"}


@pytest.fixture
def robot() -> PictureRobot:
    return PictureRobot()


async def opened(server: Server) -> PicturePage:
    """Open a page; return it once it has received something."""
    page: PicturePage = server.open(PicturePage())
    await until(lambda: page.received)
    return page


async def test_the_first_page_requests_and_the_last_one_withdraws(robot: PictureRobot, server: Server) -> None:
    await asyncio.sleep(0.1)
    assert robot.published == []
    first, second = await opened(server), await opened(server)
    await until(lambda: server.shows("flowing") and server.view.viewers == 2)
    assert (robot.encodings, robot.flags, server.view.encoding) == (["h264"], [True], "h264")
    first.leave()
    await until(lambda: server.view.viewers == 1)
    assert robot.encodings == ["h264"]
    second.leave()
    await until(lambda: server.shows("rest"))
    await until(lambda: (robot.encodings, robot.flags) == (["h264", None], [True, False]))


async def _is_asked_for_nothing(section: dict[str, Any]) -> None:
    robot = PictureRobot(section)
    async with serving(robot) as server:
        page = server.open(PicturePage())
        await until(lambda: server.shows("refused"))
        page.acknowledge(0, 0)
        await asyncio.sleep(0.6)
        assert (robot.published, server.subscribed) == ([], [])


async def test_a_robot_that_offers_nothing_or_topics_of_others_is_asked_for_nothing() -> None:
    """Nor is anything subscribed to that would bring the pictures, the sound or the commands of others."""
    sections = ({}, VIDEO | {"controls": False}, VIDEO | FOREIGN, VIDEO | {"topic": "+/+/+/outgoing/#"})
    await asyncio.gather(*map(_is_asked_for_nothing, sections))


async def test_capabilities_that_change_later_end_the_request(robot: PictureRobot, server: Server) -> None:
    await opened(server)
    robot.announce(VIDEO | FOREIGN)
    await until(lambda: server.shows("refused"))
    await until(lambda: (robot.encodings, robot.flags) == (["h264", None], [True, False]))
    assert {message.topic for message in robot.published} == {robot.request, robot.flag}


async def test_a_page_that_sends_what_is_not_understood_is_closed(server: Server) -> None:
    other = await opened(server)
    for message in (b"", b"123", bytes(1000)):
        page = await opened(server)
        page.send(message)
        await until(lambda page=page: page.closed is not None)
    assert other.closed is None


async def test_closing_withdraws_and_closes_the_sockets(robot: PictureRobot, server: Server) -> None:
    page = await opened(server)
    await server.media.close()
    await server.sound.close()
    await until(lambda: page.closed is not None)
    await until(lambda: robot.encodings[-1] is None)
    late = server.open(PicturePage())
    await until(lambda: late.closed is not None)


# -- pictures


@pytest.mark.parametrize("can", [EVERYTHING, frozenset({"json"})])
async def test_payloads_arrive_unchanged_and_decodable(
    robot: PictureRobot, server: Server, can: frozenset[str]
) -> None:
    page = server.open(PicturePage(), can)
    await until(lambda: len(page.frames) > 10)
    bodies, decoder = page.direct(), VideoDecoder()
    assert set(bodies) <= set(robot.sent)
    assert None not in [decoder.feed(body) for body in bodies]
    assert [seq for seq, _, _ in page.frames] == sorted({seq for seq, _, _ in page.frames})


async def test_a_page_that_wants_a_key_frame_gets_one(robot: PictureRobot, server: Server) -> None:
    page = server.open(PicturePage())
    await until(lambda: len(page.frames) > 5)
    page.acknowledge(1 << 31, 1)  # no frame that it got
    await asyncio.sleep(1.0)  # one is requested once a second
    assert not any(request.get("keyframe") for request in robot.requests)
    count = len(page.frames)
    page.what = 1
    await until(lambda: any(request.get("keyframe") for request in robot.requests))
    await until(lambda: len(page.frames) > count + 3)


async def test_a_page_that_decodes_nothing_gets_jpegs() -> None:
    robot = PictureRobot({**VIDEO, "encodings": ["h264"], "encoding": "h264"})
    async with serving(robot) as server:
        page = server.open(PicturePage(), frozenset())
        await until(lambda: page.rescued())
        start, count = time.monotonic(), len(page.frames)
        await until(lambda: len(page.frames) > count + 3)
        assert time.monotonic() - start > 0.5, "a few a second"
        assert page.direct() == []
        pictures = [cv2.imdecode(np.frombuffer(body, np.uint8), cv2.IMREAD_COLOR) for body in page.rescued()]
        numbers = [read_counter(picture) or 0 for picture in pictures]
        assert numbers == sorted(numbers)
        assert numbers[-1] >= len(robot.sent) - 40
        captured = int.from_bytes(page.frames[-1][2][:8], "big")
        assert 0 <= time.time() * 1000 - captured < 5000


async def test_without_pyav_there_is_a_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rescue.pyav, "installed", lambda: False)
    robot = PictureRobot({**VIDEO, "encodings": ["h264"]})
    async with serving(robot) as server:
        page = server.open(PicturePage(), EVERYTHING - {"h264"})
        await until(lambda: server.view and server.view.state == "flowing" and "needs PyAV" in server.view.why)
        assert page.frames == []


async def test_a_still_is_the_newest_key_frame_and_the_last_one_of_a_camera_that_rests(
    robot: PictureRobot, server: Server
) -> None:
    assert await server.media.snapshot(REF) is None
    assert await server.media.snapshot("#") is None
    assert robot.published == []
    page = server.open(PicturePage())
    await until(lambda: len(page.frames) > 10)
    still = await server.media.snapshot(REF)
    assert still is not None
    picture = cv2.imdecode(np.frombuffer(still[0], np.uint8), cv2.IMREAD_COLOR)
    assert len(robot.sent) - 70 <= (read_counter(picture) or 0) <= len(robot.sent)
    robot.mute = True
    await until(lambda: server.view.state == "silent")
    assert await server.media.snapshot(REF) is not None
