"""The request for pictures or sound of one robot: made for the first page, withdrawn after the last one."""

from __future__ import annotations

import asyncio
import operator
from collections.abc import Callable
from typing import Any, NamedTuple

import pytest

from tests.ext.page.media.robots import (
    MediaRobot,
    Page,
    PicturePage,
    PictureRobot,
    Server,
    SoundPage,
    SoundRobot,
    serving,
    until,
)

pytestmark = pytest.mark.anyio


class Kind(NamedTuple):
    """One medium: its robot, its page, how many pages a view counts, and its words."""

    robot: type[MediaRobot]
    page: Callable[[], Page]
    count: Callable[[Any], int]
    nonsense: tuple[bytes, ...]
    lacking: str
    fixed: str


PICTURE = Kind(
    PictureRobot,
    PicturePage,
    operator.attrgetter("viewers"),
    (b"", b"123", bytes(1000)),
    "it has no camera",
    "its camera cannot be switched on from here",
)
VOICE = Kind(
    SoundRobot,
    SoundPage,
    operator.attrgetter("listeners"),
    (b"", b"\0", b"\x07\0\0\0\1", b"\1" * 50, bytes(2000)),
    "it has no sound",
    "its sound cannot be switched on from here",
)
OTHER = "pebble/robots/victim"
#: Topics that capabilities may not name, by their key; test_robot_commands has more.
HOSTILE: list[tuple[str, object]] = [
    ("topic", f"{OTHER}/outgoing/front-camera"),
    ("command_topic", f"{OTHER}/incoming/drive-values"),
    ("flag_topic", f"{OTHER}/incoming/flags/reboot"),
    ("topic", "+/+/+/outgoing/#"),
]


@pytest.fixture(params=[PICTURE, VOICE], ids=["picture", "sound"])
def kind(request: pytest.FixtureRequest) -> Kind:
    found: Kind = request.param
    return found


@pytest.fixture
def robot(kind: Kind) -> MediaRobot:
    return kind.robot()


async def opened(server: Server, kind: Kind, count: int = 1) -> Page:
    """A page that has received this many payloads."""
    page: Page = server.open(kind.page())
    await until(lambda: len(page.received) >= count)
    return page


async def test_the_first_page_requests_and_the_last_one_withdraws(kind: Kind, robot: Any, server: Server) -> None:
    await asyncio.sleep(0.1)
    assert robot.published == []
    first, second = server.open(kind.page()), server.open(kind.page())
    await until(lambda: len(first.received) > 5 and len(second.received) > 5)
    assert robot.encodings == [robot.best]
    assert robot.flags == [True]
    await until(lambda: server.shows("flowing") and kind.count(server.view) == 2)
    assert server.view.encoding == robot.best
    first.leave()
    await until(lambda: kind.count(server.view) == 1)
    assert robot.encodings == [robot.best]
    second.leave()
    await until(lambda: server.shows("rest"))
    await until(lambda: robot.encodings == [robot.best, None])
    await until(lambda: robot.flags == [True, False])


async def _is_asked_for_nothing(kind: Kind, change: dict[str, Any] | None, why: str) -> None:
    robot: Any = kind.robot({} if change is None else {**kind.robot.section, **change})
    async with serving(robot) as server:
        page = server.open(kind.page())
        await until(lambda: server.shows("refused"))
        assert why in server.view.why
        page.send(b"\1" + bytes(8 + 640))  # of sound: a piece of a voice; of pictures: nonsense
        await asyncio.sleep(0.6)
        assert robot.published == []
        assert server.subscribed == []


async def test_a_robot_that_offers_nothing_or_topics_of_others_is_asked_for_nothing(kind: Kind) -> None:
    """Nor is anything subscribed to that would bring the pictures, the sound or the commands of others."""
    rows: list[tuple[dict[str, Any] | None, str]] = [
        ({"available": False, "controls": False}, kind.lacking),
        (None, kind.lacking),
        ({"available": "yes"}, kind.lacking),
        ({"controls": False}, kind.fixed),
        *(({key: topic}, f"not its own ({key})") for key, topic in HOSTILE),
    ]
    await asyncio.gather(*(_is_asked_for_nothing(kind, change, why) for change, why in rows))


@pytest.mark.parametrize("change", [{"controls": False}, *({key: topic} for key, topic in HOSTILE[:3])])
async def test_capabilities_that_change_later_end_the_request(
    kind: Kind, robot: Any, server: Server, change: dict[str, Any]
) -> None:
    await opened(server, kind)
    robot.announce({**robot.section, **change})
    await until(lambda: server.shows("refused"))
    await until(lambda: robot.encodings == [robot.best, None] and robot.flags == [True, False])
    assert {message.topic for message in robot.published} == {robot.request, robot.flag}


async def test_a_page_that_sends_what_is_not_understood_is_closed(kind: Kind, server: Server) -> None:
    pages = [await opened(server, kind) for _ in kind.nonsense]
    other = await opened(server, kind)
    for page, message in zip(pages, kind.nonsense, strict=True):
        page.send(message)
    await until(lambda: all(page.closed is not None for page in pages))
    assert other.closed is None


async def test_closing_withdraws_and_closes_the_sockets(kind: Kind, robot: Any, server: Server) -> None:
    page = await opened(server, kind)
    await server.media.close()
    await server.sound.close()
    await until(lambda: page.closed is not None)
    await until(lambda: robot.encodings[-1] is None)
    late = server.open(kind.page())
    await until(lambda: late.closed is not None)
