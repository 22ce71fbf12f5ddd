"""The server between one robot's microphone and loudspeaker, and the pages that listen and talk."""

from __future__ import annotations

import asyncio
import time
from functools import partial
from itertools import pairwise

import pytest

from pebble.contract import LINK, codec
from pebble.contract.payloads import LinkState
from pebble.extensions.media.packets import Sound
from pebble.extensions.page.media.sound import MAX_PACKETS, WINDOW, SoundQueue
from pebble.extensions.page.media.talk import LATE_S, PIECE_BYTES, PIECES_PER_S, SILENT_S, Talk, Voice
from pebble.transports import Message
from tests.ext.page.media.robots import AUDIO, REF, UPLINK, Server, SoundPage, SoundRobot, serving, until

pytestmark = pytest.mark.anyio
PLAIN, NOTHING = frozenset({"pcm"}), frozenset[str]()


@pytest.fixture
def robot() -> SoundRobot:
    return SoundRobot()


@pytest.fixture
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing that this machine delays is too late; that has tests of its own."""
    monkeypatch.setattr("pebble.extensions.page.media.talk.LATE_S", 60.0)
    monkeypatch.setattr("pebble.extensions.page.media.talk.SILENT_S", 60.0)


# -- listening


def test_the_queue_of_a_slow_page_is_bounded_and_its_oldest_is_dropped() -> None:
    queue = SoundQueue()
    packets = [bytes([number]) * 100 for number in range(200)]
    for packet in packets:
        queue.offer(packet)
    assert [queue.take() for _ in range(MAX_PACKETS)] == packets[-MAX_PACKETS:]
    assert queue.take() is None
    sent = 0
    for packet in packets:
        queue.offer(packet)
        sent += queue.take() is not None
    assert sent == WINDOW - MAX_PACKETS
    queue.acknowledge(5)
    assert [queue.take() is not None for _ in range(6)] == [True] * 5 + [False]
    queue.acknowledge(1 << 31)  # more than was sent
    assert queue.take() is not None
    queue.offer(bytes(300_000))
    assert queue.take() is None, "larger than everything that may wait"


async def test_a_page_that_acknowledges_nothing_gets_a_window_and_delays_no_other(server: Server) -> None:
    slow, fast = server.open(SoundPage(answers=False)), server.open(SoundPage())
    await until(lambda: len(fast.received) > WINDOW + 5)
    assert len(slow.received) == WINDOW


async def test_what_is_no_sound_is_not_passed_on(robot: SoundRobot, server: Server) -> None:
    page = server.open(SoundPage())
    await until(lambda: page.received)
    big = Sound(1, 1, 16000, 320, 1, 1, bytes(300_000)).pack()
    bad = {b"", b"PBAT", Sound(9, 1, 16000, 1, 1, 1, b"xx").pack(), big}
    for payload in bad:
        robot.send(payload)
    count = len(page.received)
    await until(lambda: len(page.received) > count + 5)
    assert not set(page.received) & bad


async def test_a_page_that_sends_what_is_not_understood_is_closed(server: Server) -> None:
    for message in (b"", b"\x07\0\0\0\1", b"\1" * 50, bytes(2000)):
        page = server.open(SoundPage())
        page.send(message)
        await until(lambda page=page: page.closed is not None)


# -- talking


async def test_no_voice_takes_the_room_of_commands_on_a_thin_link(robot: SoundRobot, server: Server) -> None:
    link = codec.encode(LINK, LinkState(level="thin", drive_hz=4, rtt_ms=600, queue_ms=0, t=1))
    server.robots.receive(Message(LINK.topic(REF), link), time.monotonic())
    page = server.open(SoundPage(), NOTHING)
    await page.speak(1, 3)
    await until(lambda: page.talks)
    assert page.talks == [{"talk": 1, "on": False, "why": "The connection of goob is too slow for a voice"}]
    assert robot.voice == []


@pytest.mark.usefixtures("patient")
async def test_a_voice_reaches_the_robot_which_is_asked_to_play_it(robot: SoundRobot, server: Server) -> None:
    page = server.open(SoundPage(), NOTHING)
    sent = await page.speak(1, 20)
    await until(lambda: len(robot.voice) == 20)
    assert b"".join(packet.body for packet in robot.voice) == sent
    assert {(one.codec, one.channels, one.rate, one.samples) for one in robot.voice} == {(1, 1, 16000, 320)}
    assert all(b.sequence == a.sequence + 1 for a, b in pairwise(robot.voice))
    assert all(abs(one.captured_ms - 1000 * time.time()) < 10_000 for one in robot.voice)
    assert (robot.flags, robot.encodings) == ([True], ["opus"])
    assert (page.received, page.talks) == ([], [{"talk": 1, "on": True, "why": ""}]), "it only talks"
    await until(lambda: (server.view.talker, server.view.listeners) == ("alice", 0))
    assert server.noted == [(REF, "alice")]
    page.end(1)
    await until(lambda: server.view.talker == "")
    page.leave()
    await until(lambda: robot.flags == [True, False])


@pytest.mark.usefixtures("patient")
async def test_a_second_talker_is_refused_until_the_first_one_is_done(robot: SoundRobot, server: Server) -> None:
    bob, eve = server.open(SoundPage(), user="bob"), server.open(SoundPage(), user="eve")
    talking = asyncio.create_task(bob.speak(1, 25))
    await until(lambda: server.view and server.view.talker == "bob")
    await eve.speak(1, 5)
    await until(lambda: eve.talks)
    assert eve.talks == [{"talk": 1, "on": False, "why": "bob is talking"}]
    sent = await talking
    bob.end(1)
    eve.send_piece(1, 6, bytes(PIECE_BYTES))  # the refused one does not begin now
    await until(lambda: server.view.talker == "")
    await until(lambda: len(robot.voice) == 25)
    assert b"".join(packet.body for packet in robot.voice) == sent
    await eve.speak(2, 5)
    await until(lambda: server.view.talker == "eve")
    assert server.noted == [(REF, "bob"), (REF, "eve")]


async def test_a_talk_ends_with_its_socket_and_after_a_second_without_sound(
    robot: SoundRobot, server: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    bob, eve = server.open(SoundPage(), user="bob"), server.open(SoundPage(), user="eve")
    await bob.speak(1, 3)
    await until(lambda: bob.talks[-1:] == [{"talk": 1, "on": False, "why": "No sound came in time for 1 s"}])
    await until(lambda: server.view.talker == "")
    monkeypatch.setattr("pebble.extensions.page.media.talk.SILENT_S", 60.0)
    await bob.speak(2, 3)
    await until(lambda: server.view.talker == "bob")
    bob.leave()
    await until(lambda: server.view.talker == "")
    await eve.speak(1, 3)
    await until(lambda: eve.talks)
    assert eve.talks == [{"talk": 1, "on": True, "why": ""}]


async def test_the_voice_goes_to_the_robots_own_topic_only() -> None:
    for named, topic in [
        (f"{REF}/incoming/voice", f"{REF}/incoming/voice"),
        (f"{REF}/incoming/drive-values", UPLINK),
        ("pebble/robots/victim/incoming/audio-stream", UPLINK),
    ]:
        robot = SoundRobot({**AUDIO, "uplink_topic": named})
        async with serving(robot) as server:
            await server.open(SoundPage(), NOTHING).speak(1, 3)
            await until(partial(_was_published, robot, topic))
            assert all(one.topic.startswith(f"{REF}/incoming/") for one in robot.published)


def _was_published(robot: SoundRobot, topic: str) -> bool:
    return topic in {one.topic for one in list(robot.published)}


def test_what_a_stalled_connection_held_back_is_not_played() -> None:
    talk = Talk(1, 0.0)
    assert all(talk.takes(number, 10 + number / PIECES_PER_S) for number in range(100))
    stalled = 10 + 100 / PIECES_PER_S + 1.0
    taken = [talk.takes(number, stalled) for number in range(100, 150)]
    assert taken.index(True) == pytest.approx(50 * (1 - LATE_S), abs=2)
    assert all(talk.takes(number, 10 + number / PIECES_PER_S + 0.02) for number in range(150, 200))
    assert not talk.is_over(10 + 200 / PIECES_PER_S)
    assert talk.is_over(10 + 200 / PIECES_PER_S + SILENT_S + 0.1)


def test_a_talk_of_which_everything_is_late_is_over() -> None:
    talk = Talk(1, 0.0)
    assert talk.takes(0, 10.0)
    lost = 10.0 + LATE_S + 0.1  # the page's microphone has skipped so much
    assert not any(talk.takes(number, lost + number / PIECES_PER_S) for number in range(1, 60))
    assert talk.is_over(lost + 60 / PIECES_PER_S)


def test_a_microphone_whose_clock_is_slow_works_for_an_hour() -> None:
    talk = Talk(1, 0.0)
    assert all(talk.takes(number, number / PIECES_PER_S * 1.0005) for number in range(3600 * PIECES_PER_S))


def test_after_the_last_number_comes_1() -> None:
    voice = Voice()
    voice.begin((0xFFFF_FFFE + 0.5) / PIECES_PER_S)
    numbers = [Sound.unpack(voice.packet(bytes(PIECE_BYTES), 1.0)).sequence for _ in range(3)]
    assert numbers == [0xFFFF_FFFF, 1, 2]
