"""The server between one robot's camera and the pages that show it."""

from __future__ import annotations

import asyncio
import itertools
import time
from collections.abc import Callable, Coroutine
from functools import wraps
from typing import Any

import cv2
import numpy as np
import pytest

from pebble.client.media_request import request
from pebble.client.media_request.picture_header import follows, read_header
from pebble.client.media_request.queue import NO_FRAME
from pebble.media.decode import VideoDecoder, encoding_of
from pebble.media.scene import read_counter
from pebble.media.video import make_encoder
from pebble.transports import QoS
from pebble.web.media import rescue
from tests.web.picture_robot import (
    CAMERA,
    CAPABILITIES,
    EVERYTHING,
    FLAG,
    REF,
    REQUEST,
    VIDEO,
    Page,
    PictureRobot,
    capabilities,
    serving,
    until,
)

PLAIN = EVERYTHING - {"h264"}


def on_loop(test: Callable[..., Coroutine[Any, Any, None]]) -> Callable[..., None]:
    @wraps(test)
    def run(*args: Any, **kwargs: Any) -> None:
        asyncio.run(asyncio.wait_for(test(*args, **kwargs), 40))

    return run


@pytest.fixture(autouse=True)
def _short_linger(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(request, "LINGER_S", 0.4)


def jpeg(number: int = 0) -> bytes:
    return cv2.imencode(".jpg", np.full((48, 64, 3), 40 + number % 150, np.uint8))[1].tobytes()


def wanted(robot: PictureRobot) -> list[str | None]:
    """The encodings that were requested, None for the end: without key frames, and without repetitions."""
    ends = [request for request in robot.requests if not request.get("keyframe")]
    encodings = [request.get("encoding", "") if request["enabled"] else None for request in ends]
    return [name for name, _ in itertools.groupby(encodings)]


# -- the request


@on_loop
async def test_the_first_page_requests_and_the_last_one_withdraws() -> None:
    robot = PictureRobot()
    async with serving(robot) as server:
        await asyncio.sleep(0.1)
        assert robot.published == []
        first, second = server.open(Page()), server.open(Page())
        await until(lambda: len(first.frames) > 5 and len(second.frames) > 5)
        assert wanted(robot) == ["h264"]
        assert robot.flags == [True]
        await until(lambda: server.view.state == "flowing")
        await until(lambda: server.view.viewers == 2)
        assert server.view.encoding == "h264"
        first.leave()
        await until(lambda: server.view.viewers == 1)
        second.leave()
        await until(lambda: server.view.state == "rest")
        await until(lambda: wanted(robot) == ["h264", None])
        await until(lambda: robot.flags == [True, False])


@on_loop
async def test_a_page_that_reloads_does_not_restart_the_camera() -> None:
    robot = PictureRobot()
    async with serving(robot) as server:
        for _ in range(3):
            page = server.open(Page())
            await until(lambda page=page: len(page.frames) > 3)
            page.leave()
            await asyncio.sleep(0.1)
        assert wanted(robot) == ["h264"]


@on_loop
async def test_a_flag_that_was_up_stays_up() -> None:
    robot = PictureRobot()
    robot.transport.publish(FLAG, b'{"value":true}', qos=QoS.DELIVERED, retain=True)
    robot._flag = True
    async with serving(robot) as server:
        page = server.open(Page())
        await until(lambda: page.frames)
        page.leave()
        await until(lambda: server.view.state == "rest")
    assert robot.flags == []


@on_loop
async def test_pictures_are_requested_again_while_none_come() -> None:
    robot = PictureRobot()
    async with serving(robot) as server:
        page = server.open(Page())
        await until(lambda: page.frames)
        robot.mute = True
        count = len(robot.requests)
        await until(lambda: server.view.state == "silent")
        assert server.view.why.startswith("no picture for")
        await until(lambda: len(robot.requests) > count)
        robot.mute = False
        await until(lambda: server.view.state == "flowing")


@pytest.mark.parametrize(
    ("video", "why"),
    [
        ({"available": False, "controls": False}, "it has no camera"),
        ({}, "it has no camera"),
        ({**VIDEO, "controls": False}, "its camera cannot be switched on from here"),
        ({**VIDEO, "available": "yes"}, "it has no camera"),
    ],
)
@on_loop
async def test_a_robot_without_a_camera_is_asked_for_nothing(video: dict[str, Any], why: str) -> None:
    robot = PictureRobot(video)
    async with serving(robot) as server:
        server.open(Page())
        await until(lambda: server.view and server.view.state == "refused")
        assert server.view.why == why
        await asyncio.sleep(0.7)
        assert robot.published == []


OTHER = "pebble/robots/victim"


@pytest.mark.parametrize(
    ("key", "topic"),
    [
        ("topic", f"{OTHER}/outgoing/front-camera"),
        ("topic", "#"),
        ("topic", "+/+/+/outgoing/#"),
        ("topic", f"{REF}/outgoing/#"),
        ("topic", f"{REF}/incoming/drive-values"),
        ("topic", f"{REF}x/outgoing/front-camera"),
        ("topic", 7),
        ("command_topic", f"{OTHER}/incoming/front-camera"),
        ("command_topic", f"{OTHER}/incoming/drive-values"),
        ("command_topic", f"{REF}/outgoing/online"),
        ("command_topic", f"{REF}/incoming/a/../../../victim"),
        ("flag_topic", f"{OTHER}/incoming/flags/reboot"),
        ("flag_topic", "$SYS/broker"),
        ("flag_topic", f"{REF}/incoming/+"),
    ],
)
@on_loop
async def test_capabilities_cannot_lead_it_to_other_topics(key: str, topic: object) -> None:
    robot = PictureRobot({**VIDEO, key: topic})
    async with serving(robot) as server:
        subscribed: list[str] = []
        subscribe = server.broker.transport.subscribe
        server.broker.transport.subscribe = lambda filter_, *args, **options: (  # type: ignore[method-assign]
            subscribed.append(filter_) or subscribe(filter_, *args, **options)
        )
        server.open(Page())
        if topic == f"{REF}/incoming/a/../../../victim":  # levels named ".." mean nothing: the topic is its own
            await until(lambda: robot.published)
        else:
            await until(lambda: server.view and server.view.state == "refused")
        await asyncio.sleep(0.6)
        assert all(message.topic.startswith(f"{REF}/incoming/") for message in robot.published)
        assert all(filter_.startswith((f"{REF}/incoming/", f"{REF}/outgoing/")) for filter_ in subscribed)
        assert not any(set(filter_) & set("+#") for filter_ in subscribed)


@pytest.mark.parametrize("key", ["topic", "command_topic", "flag_topic"])
@on_loop
async def test_nor_can_capabilities_that_change_later(key: str) -> None:
    robot = PictureRobot()
    async with serving(robot) as server:
        page = server.open(Page())
        await until(lambda: page.frames)
        hostile = {**VIDEO, key: f"{OTHER}/incoming/drive-values"}
        robot.transport.publish(CAPABILITIES, capabilities(hostile), qos=QoS.DELIVERED, retain=True)
        await until(lambda: server.view.state == "refused")
        await asyncio.sleep(0.6)
    assert {message.topic for message in robot.published} == {REQUEST, FLAG}


@on_loop
async def test_a_page_cannot_name_a_filter() -> None:
    robot = PictureRobot()
    async with serving(robot) as server:
        pages = [
            server.open(Page(), ref=ref) for ref in ("+/+/+", "#", "", "pebble/robots/#", "a/b", "a/b/c/d", "$x/y/z")
        ]
        await until(lambda: all(page.closed for page in pages))
        assert robot.published == []


# -- the encoding


@on_loop
async def test_the_encoding_is_one_that_all_pages_decode() -> None:
    robot = PictureRobot()
    async with serving(robot) as server:
        first = server.open(Page())
        await until(lambda: len(first.frames) > 3)
        second = server.open(Page(), PLAIN)
        await until(lambda: len(second.direct()) > 3)
        assert {encoding_of(body) for body in second.direct()} == {"pbvz"}
        assert encoding_of(first.direct()[-1]) == "pbvz"
        server.media.pin(REF, "json")
        await until(lambda: encoding_of(first.direct()[-1]) == "json")
        await until(lambda: server.view.pinned == "json")
        server.media.pin(REF, "")
        await until(lambda: encoding_of(second.direct()[-1]) == "pbvz")
        server.media.pin("pebble/robots/unknown", "json")
        server.media.pin(REF, "mpeg")
        assert wanted(robot) == ["h264", "pbvz", "json", "pbvz"]


@on_loop
async def test_another_operators_encoding_is_forwarded_as_it_is() -> None:
    robot = PictureRobot()
    async with serving(robot) as server:
        page = server.open(Page())
        await until(lambda: len(page.frames) > 3)
        other = robot.hub
        with type(robot.transport)("other", other) as operator:
            operator.publish(REQUEST, b'{"enabled":true,"encoding":"pbvd"}', qos=QoS.DELIVERED)
            await until(lambda: encoding_of(page.direct()[-1]) == "pbvd")
            await asyncio.sleep(1.5)
        assert encoding_of(page.direct()[-1]) == "pbvd"
        assert [request.get("encoding") for request in robot.requests if "keyframe" not in request].count("h264") == 1


@on_loop
async def test_a_robot_that_lists_no_encodings_sends_what_it_sends() -> None:
    video = {name: value for name, value in VIDEO.items() if name != "encodings"} | {"encoding": "jpeg"}
    robot = PictureRobot({**video, "encoding": "json"})
    async with serving(robot) as server:
        page = server.open(Page())
        await until(lambda: len(page.frames) > 3)
        assert wanted(robot) == [""]


@on_loop
async def test_raw_jpegs_flow() -> None:
    robot = PictureRobot({**{name: VIDEO[name] for name in ("available", "controls", "topic")}, "encoding": "jpeg"})
    robot.mute = True
    async with serving(robot) as server:
        page = server.open(Page(), frozenset({"jpeg"}))
        await until(lambda: robot.requests)
        for number in range(5):
            robot.send(jpeg(number))
            await until(lambda number=number: page.direct() == [jpeg(one) for one in range(number + 1)])
        await until(lambda: server.view.state == "flowing" and server.view.encoding == "jpeg")


# -- forwarding


def decoded(bodies: list[bytes]) -> list[int | None]:
    decoder = VideoDecoder()
    shown = [decoder.feed(body) for body in bodies]
    return [None if one is None else read_counter(one.picture) for one in shown]


@pytest.mark.parametrize("can", [EVERYTHING, PLAIN, frozenset({"json"}), frozenset({"pbvd"})])
@on_loop
async def test_payloads_arrive_unchanged_and_decodable(can: frozenset[str]) -> None:
    robot = PictureRobot()
    async with serving(robot) as server:
        page = server.open(Page(), can)
        await until(lambda: len(page.frames) > 20)
        bodies = page.direct()
        assert set(bodies) <= set(robot.payloads)
        assert None not in decoded(bodies)
        assert [seq for seq, _, _ in page.frames] == sorted({seq for seq, _, _ in page.frames})


@on_loop
async def test_what_follows_a_lost_picture_is_not_sent() -> None:
    robot = PictureRobot()
    robot.mute = True
    encoder = make_encoder("pbvd", fps=15, keyframe_interval=5)
    packets = [encoder.encode(np.full((48, 64, 3), n, np.uint8), 1_710_969_600_000 + 66 * n) for n in range(12)]
    async with serving(robot) as server:
        page = server.open(Page())
        await until(lambda: robot.requests)
        arrives = [*packets[:3], *packets[5:7], packets[10]]
        for packet in [
            *(packets[3], *packets[:3], packets[4], b"garbage", bytes(5 << 20)),
            *(*packets[5:7], packets[6], packets[7], packets[10]),
        ]:
            count = len(page.frames) + (packet in arrives and packet not in page.direct())
            robot.send(packet)
            await until(lambda count=count: len(page.frames) == count)
            await asyncio.sleep(0.02)
        assert page.direct() == arrives


def test_headers_are_read_as_the_decoder_reads_them() -> None:
    for name in ("json", "pbvd", "pbvz", "h264"):
        encoder, last, decoder = make_encoder(name, fps=15, keyframe_interval=4), None, VideoDecoder()
        for number in range(9):
            payload = encoder.encode(np.full((48, 64, 3), 20 * number, np.uint8), 1_710_969_600_000 + 66 * number)
            header, shown = read_header(payload), decoder.feed(payload)
            assert header is not None
            assert shown is not None
            assert header == (shown.encoding, shown.keyframe, shown.frame, shown.captured_ms)
            assert follows(last, header)
            last = header
    assert [read_header(raw) for raw in (b"", b"x", b"PBVD", b"{", b"[]", b" 7", b"PBVD\1\x09" + bytes(20))] == [
        None
    ] * 7


@on_loop
async def test_a_slow_page_gets_key_frames_and_a_fast_one_everything() -> None:
    robot = PictureRobot()
    async with serving(robot) as server:
        fast, slow = server.open(Page(), PLAIN), server.open(Page(answer=None), PLAIN)
        end = time.monotonic() + 3
        acknowledged = 0
        while time.monotonic() < end:
            await asyncio.sleep(0.3)
            for seq, _, _ in slow.frames[acknowledged : acknowledged + 1]:
                slow.acknowledge(seq, 0)
                acknowledged += 1
        assert len(slow.frames) - acknowledged <= 8
        assert None not in decoded(fast.direct())
        assert None not in decoded(slow.direct())
        assert acknowledged <= len(slow.frames) < len(fast.frames)


@on_loop
async def test_a_page_that_answers_nonsense_is_closed() -> None:
    robot = PictureRobot()
    async with serving(robot) as server:
        pages = [server.open(Page()) for _ in range(3)]
        await until(lambda: all(page.frames for page in pages))
        pages[0].send_raw(b"123")
        pages[1].send_raw(bytes(1000))
        await until(lambda: pages[0].closed and pages[1].closed)
        assert pages[2].closed is None


@on_loop
async def test_a_page_that_wants_a_key_frame_gets_one() -> None:
    robot = PictureRobot()
    async with serving(robot) as server:
        page = server.open(Page())
        await until(lambda: len(page.frames) > 5)
        await asyncio.sleep(1.0)
        count, began = len(page.frames), time.monotonic() - 2
        page.acknowledge(NO_FRAME, 1)
        await until(lambda: any(request.get("keyframe") for request in robot.requests))
        await until(lambda: len(page.frames) > count + 3)
        for _ in range(20):
            page.acknowledge(NO_FRAME, 1)
            await asyncio.sleep(0.05)
        elapsed = time.monotonic() - began
        assert sum(request.get("keyframe", False) for request in robot.requests) <= 2 + elapsed


@on_loop
async def test_the_view_changes_at_most_twice_a_second() -> None:
    robot = PictureRobot()
    async with serving(robot) as server:
        page = server.open(Page())
        await until(lambda: len(page.frames) > 45)
        times = [at for at, _ in server.views]
        assert len(times) > 3
        assert min(b - a for a, b in itertools.pairwise(times)) > 0.45
        assert server.view.per_second == pytest.approx(15, rel=0.5)
        assert server.view.kbits > 0


# -- rescue


@pytest.mark.parametrize("pinned", ["h264", "pbvz", "json"])
@on_loop
async def test_a_page_that_decodes_nothing_gets_jpegs(pinned: str) -> None:
    robot = PictureRobot(fps=20)
    async with serving(robot) as server:
        server.media.pin(REF, pinned)
        page, start = server.open(Page(), frozenset()), 0.0
        await until(lambda: page.rescued())
        start, count = time.monotonic(), len(page.frames)
        await asyncio.sleep(2)
        rate = (len(page.frames) - count) / (time.monotonic() - start)
        assert 0.5 < rate <= 5.5
        assert page.direct() == []
        pictures = [cv2.imdecode(np.frombuffer(body, np.uint8), cv2.IMREAD_COLOR) for body in page.rescued()]
        numbers = [read_counter(picture) for picture in pictures]
        assert numbers == sorted(number for number in numbers if number is not None)
        assert numbers[-1] >= robot.frames - 40
        captured = int.from_bytes(page.frames[-1][2][:8], "big")
        assert 0 <= time.time() * 1000 - captured < 5000


@on_loop
async def test_a_slow_page_among_fast_ones_is_rescued() -> None:
    robot = PictureRobot(fps=20)
    async with serving(robot) as server:
        fast = [server.open(Page()) for _ in range(3)]
        slow = server.open(Page(answer=None))
        await until(lambda: len(slow.frames) >= 2)
        await asyncio.sleep(2.0)
        for seq, _, _ in list(slow.frames):
            slow.acknowledge(seq, 0)
        slow.answer = 0
        await until(lambda: len(slow.rescued()) > 3)
        assert all(None not in decoded(page.direct()) for page in fast)


@on_loop
async def test_a_page_that_fails_to_decode_is_rescued() -> None:
    robot = PictureRobot()
    async with serving(robot) as server:
        page, other = server.open(Page(answer=2)), server.open(Page())
        await until(lambda: len(page.rescued()) > 2)
        await until(lambda: len(other.direct()) > 10)
        assert len(page.direct()) <= 8


@on_loop
async def test_without_pyav_there_is_a_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rescue.pyav, "installed", lambda: False)
    robot = PictureRobot()
    async with serving(robot) as server:
        server.media.pin(REF, "h264")
        page = server.open(Page(), PLAIN)
        await until(lambda: server.view.state == "flowing" and "needs PyAV" in server.view.why)
        assert "1 of 1 browsers cannot show it" in server.view.why
        assert page.frames == []
        server.media.pin(REF, "")
        await until(lambda: page.direct())
        nothing = server.open(Page(), frozenset())
        await until(lambda: nothing.rescued())


@on_loop
async def test_a_snapshot_is_the_newest_picture_and_starts_no_camera() -> None:
    robot = PictureRobot()
    async with serving(robot) as server:
        assert await server.media.snapshot(REF) is None
        assert await server.media.snapshot("#") is None
        assert robot.published == []
        page = server.open(Page())
        await until(lambda: len(page.frames) > 30)
        taken = await asyncio.gather(*(server.media.snapshot(REF) for _ in range(10)))
        assert len(set(taken)) == 1
        picture = cv2.imdecode(np.frombuffer(taken[0] or b"", np.uint8), cv2.IMREAD_COLOR)
        assert robot.frames - 20 <= (read_counter(picture) or 0) <= robot.frames
        robot.mute = True
        await until(lambda: server.view.state == "silent")
        assert await server.media.snapshot(REF) is None


@on_loop
async def test_closing_withdraws_and_closes_the_sockets() -> None:
    robot = PictureRobot()
    async with serving(robot) as server:
        page = server.open(Page())
        await until(lambda: page.frames)
        await server.media.close()
        await until(lambda: page.closed is not None)
        await until(lambda: wanted(robot)[-1] is None)
        late = server.open(Page())
        await until(lambda: late.closed is not None)


@on_loop
async def test_nothing_is_withdrawn_while_there_is_no_broker() -> None:
    robot = PictureRobot()
    async with serving(robot) as server:
        page = server.open(Page())
        await until(lambda: page.frames)
        server.broker.connected = False
        page.leave()
        await asyncio.sleep(1.2)
        assert robot.requests[-1]["enabled"]
        server.broker.connected = True
        await until(lambda: not robot.requests[-1]["enabled"])


@pytest.mark.alone
@on_loop
async def test_thirty_viewers_get_everything_and_the_robot_sends_no_more() -> None:
    robot = PictureRobot(fps=15)
    async with serving(robot) as server:
        alone = server.open(Page())
        await until(lambda: len(alone.frames) > 5)
        pages = [server.open(Page()) for _ in range(29)]
        await until(lambda: all(len(page.frames) > 3 for page in pages))
        await asyncio.sleep(1.0)
        before, frames, requests = [len(page.frames) for page in pages], robot.frames, len(robot.requests)
        await asyncio.sleep(3.0)
        sent = robot.frames - frames
        assert sent >= 40
        assert all(len(page.frames) - count >= 0.95 * sent - 1 for page, count in zip(pages, before, strict=True))
        assert len(robot.requests) == requests
        assert CAMERA not in {message.topic for message in robot.published}
