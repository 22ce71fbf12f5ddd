"""The server between one robot's microphone and loudspeaker, and the pages that listen and talk."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Coroutine
from functools import partial, wraps
from itertools import pairwise
from typing import Any

import pytest

from pebble.client.media_request import request
from pebble.contract.packets import Codec, Sound
from pebble.fleet.roles import Role
from pebble.transports import QoS
from pebble.web.media.sound import MAX_PACKETS, WINDOW, SoundQueue, best
from pebble.web.media.talk import LATE_S, PIECE_BYTES, PIECES_PER_S, SILENT_S, Talk, Voice
from tests.web.sound_robot import (
    AUDIO,
    CAPABILITIES,
    FLAG,
    NOTHING,
    PLAIN,
    REF,
    UPLINK,
    Page,
    SoundRobot,
    capabilities,
    serving,
    until,
)


def on_loop(test: Callable[..., Coroutine[Any, Any, None]]) -> Callable[..., None]:
    @wraps(test)
    def run(*args: Any, **kwargs: Any) -> None:
        asyncio.run(asyncio.wait_for(test(*args, **kwargs), 40))

    return run


@pytest.fixture(autouse=True)
def _short_linger(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(request, "LINGER_S", 0.4)


@pytest.fixture
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing that this machine delays is too late; that has tests of its own."""
    monkeypatch.setattr("pebble.web.media.talk.LATE_S", 60.0)
    monkeypatch.setattr("pebble.web.media.talk.SILENT_S", 60.0)


# -- listening


@on_loop
async def test_the_first_listener_requests_and_the_last_one_withdraws() -> None:
    robot = SoundRobot()
    async with serving(robot) as server:
        await asyncio.sleep(0.1)
        assert robot.published == []
        first, second = server.open(Page()), server.open(Page(), role=Role.VIEWER)
        await until(lambda: len(first.packets) > 10 and len(second.packets) > 10)
        assert robot.encodings == ["opus"]
        assert robot.flags == [True]
        assert set(first.packets) <= set(robot.sent)
        await until(lambda: server.view.state == "flowing" and server.view.listeners == 2)
        assert server.view.encoding == "opus"
        first.leave()
        await until(lambda: server.view.listeners == 1)
        assert robot.encodings == ["opus"]
        second.leave()
        await until(lambda: server.view.state == "rest")
        await until(lambda: robot.encodings == ["opus", None])
        await until(lambda: robot.flags == [True, False])


@on_loop
async def test_a_flag_that_was_up_stays_up() -> None:
    robot = SoundRobot()
    robot.transport.publish(FLAG, b'{"value":true}', qos=QoS.DELIVERED, retain=True)
    robot._flag = True
    async with serving(robot) as server:
        page = server.open(Page())
        await until(lambda: page.packets)
        page.leave()
        await until(lambda: server.view.state == "rest")
    assert robot.flags == []


@on_loop
async def test_one_listener_without_opus_is_enough_for_pcm() -> None:
    robot = SoundRobot()
    async with serving(robot) as server:
        page = server.open(Page())
        await until(lambda: page.packets)
        plain = server.open(Page(), PLAIN)
        await until(lambda: len(plain.packets) > 3)
        assert {Sound.unpack(packet).codec for packet in plain.packets} == {Codec.PCM16LE}
        plain.leave()
        await until(lambda: robot.encodings == ["opus", "pcm", "opus"])


def test_the_best_encoding_that_all_listeners_play() -> None:
    both, pcm = frozenset({"opus", "pcm"}), frozenset({"pcm"})
    assert best(("pcm", "opus"), [both, both]) == "opus"
    assert best(("pcm", "opus"), [both, pcm]) == "pcm"
    assert best(("pcm",), [both]) == "pcm"
    assert best(("opus",), [pcm]) == "opus"  # there is no other
    assert best(("pcm", "opus"), []) == "opus"  # a page that only talks
    assert best((), [both]) is None
    assert best(("flac",), [both]) is None


@on_loop
async def test_a_page_that_cannot_play_what_comes_gets_a_reason() -> None:
    robot = SoundRobot({**AUDIO, "encodings": ["opus"], "encoding": "opus"})
    async with serving(robot) as server:
        page = server.open(Page(), PLAIN)
        await until(lambda: server.view and server.view.why == "1 of 1 browsers cannot play opus")
        assert page.packets == []


#: What is no sound that may be requested, and why not.
REFUSED: list[tuple[dict[str, Any], str]] = [
    ({"available": False, "controls": False}, "it has no sound"),
    ({}, "it has no sound"),
    ({**AUDIO, "controls": False}, "its sound cannot be switched on from here"),
    ({**AUDIO, "topic": "pebble/robots/victim/outgoing/audio"}, "not its own (topic)"),
    ({**AUDIO, "command_topic": "pebble/robots/victim/incoming/drive-values"}, "not its own (command_topic)"),
    ({**AUDIO, "flag_topic": f"{REF}/incoming/+"}, "not its own (flag_topic)"),
    ({**AUDIO, "flag_topic": f"{REF}/incoming/estop"}, "not its own (flag_topic)"),
    ({**AUDIO, "command_topic": f"{REF}/incoming/flags/reboot"}, "not its own (command_topic)"),
]


@on_loop
async def test_a_robot_without_sound_is_asked_for_nothing() -> None:
    await asyncio.gather(*(_is_asked_for_nothing(audio, why) for audio, why in REFUSED))


async def _is_asked_for_nothing(audio: dict[str, Any], why: str) -> None:
    robot = SoundRobot(audio)
    async with serving(robot) as server:
        page = server.open(Page())
        await until(lambda: server.view and server.view.state == "refused")
        assert why in server.view.why
        await page.speak(1, 3)
        await until(lambda: page.talks)
        assert why in page.talks[-1]["why"]
        await asyncio.sleep(0.6)
        assert robot.published == []


@on_loop
async def test_sound_is_requested_again_while_none_comes() -> None:
    robot = SoundRobot()
    async with serving(robot) as server:
        page = server.open(Page())
        await until(lambda: page.packets)
        robot.mute = True
        count = len(robot.requests)
        await until(lambda: server.view.state == "silent" and server.view.why.startswith("no sound for"))
        await until(lambda: len(robot.requests) > count)
        robot.mute = False
        await until(lambda: server.view.state == "flowing")


def test_the_queue_of_a_slow_page_is_bounded_and_its_oldest_is_dropped() -> None:
    queue = SoundQueue()
    packets = [bytes([number]) * 100 for number in range(200)]
    for packet in packets:
        queue.offer(packet)
    assert queue.dropped == 200 - MAX_PACKETS
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


@on_loop
async def test_a_page_that_acknowledges_nothing_gets_a_window_and_delays_no_other() -> None:
    robot = SoundRobot()
    async with serving(robot) as server:
        slow, fast = server.open(Page(answers=False)), server.open(Page())
        await until(lambda: len(fast.packets) > WINDOW + 30)
        assert len(slow.packets) == WINDOW
        slow.acknowledge(WINDOW)
        await until(lambda: len(slow.packets) > WINDOW)
        newest = [Sound.unpack(page.packets[-1]).sequence for page in (slow, fast)]
        assert newest[1] - newest[0] <= MAX_PACKETS + 2


@on_loop
async def test_what_is_no_sound_is_not_passed_on() -> None:
    robot = SoundRobot()
    async with serving(robot) as server:
        page = server.open(Page())
        await until(lambda: page.packets)
        bad = [b"", b"PBAT", b"{}", Sound(9, 1, 16000, 1, 1, 1, b"xx").pack(), bytes(300_000)]
        big = Sound(1, 1, 16000, 320, 1, 1, bytes(300_000)).pack()
        for payload in (*bad, big):
            robot.send(payload)
        count = len(page.packets)
        await until(lambda: len(page.packets) > count + 5)
        assert not set(page.packets) & {*bad, big}


@on_loop
async def test_a_page_that_sends_what_is_not_understood_is_closed() -> None:
    robot = SoundRobot()
    async with serving(robot) as server:
        messages = [b"", b"\0", b"\x07\0\0\0\1", b"\1" * 50, bytes(2000)]
        pages = [server.open(Page()) for _ in messages]
        await until(lambda: all(page.packets for page in pages))
        for page, message in zip(pages, messages, strict=True):
            page.send(message)
        await until(lambda: all(page.closed is not None for page in pages))


@on_loop
async def test_closing_withdraws_and_closes_the_sockets() -> None:
    robot = SoundRobot()
    async with serving(robot) as server:
        page = server.open(Page())
        await until(lambda: page.packets)
        await server.sound.close()
        await until(lambda: page.closed is not None)
        await until(lambda: robot.encodings[-1] is None)
        late = server.open(Page())
        await until(lambda: late.closed is not None)


# -- talking


@pytest.mark.usefixtures("patient")
@on_loop
async def test_a_voice_reaches_the_robot_which_is_asked_to_play_it() -> None:
    robot = SoundRobot()
    async with serving(robot) as server:
        page = server.open(Page(), NOTHING)
        sent = await page.speak(1, 50)
        await until(lambda: len(robot.voice) == 50)
        assert b"".join(packet.body for packet in robot.voice) == sent
        assert {(one.codec, one.channels, one.rate, one.samples) for one in robot.voice} == {(1, 1, 16000, 320)}
        assert all(b.sequence == a.sequence + 1 for a, b in pairwise(robot.voice))
        assert all(abs(one.captured_ms - 1000 * time.time()) < 10_000 for one in robot.voice)
        assert robot.flags == [True]
        assert robot.encodings == ["opus"]
        assert page.packets == []  # it only talks
        assert page.talks == [{"talk": 1, "on": True, "why": ""}]
        assert server.view.talker == "alice"
        assert server.view.listeners == 0
        assert server.noted == [(REF, "alice")]
        page.end(1)
        await until(lambda: server.view.talker == "")
        page.leave()
        await until(lambda: robot.flags == [True, False])


@pytest.mark.usefixtures("patient")
@on_loop
async def test_a_second_talker_is_refused_until_the_first_one_is_done() -> None:
    robot = SoundRobot()
    async with serving(robot) as server:
        bob, eve = server.open(Page(), user="bob"), server.open(Page(), user="eve")
        talking = asyncio.create_task(bob.speak(1, 40))
        await until(lambda: server.view and server.view.talker == "bob")
        await eve.speak(1, 5)
        await until(lambda: eve.talks)
        assert eve.talks == [{"talk": 1, "on": False, "why": "bob is talking"}]
        sent = await talking
        bob.end(1)
        eve.send_piece(1, 6, bytes(PIECE_BYTES))  # the refused one does not begin now
        await until(lambda: server.view.talker == "")
        await until(lambda: len(robot.voice) == 40)
        assert b"".join(packet.body for packet in robot.voice) == sent
        await eve.speak(2, 5)
        await until(lambda: server.view.talker == "eve")
        numbers = [packet.sequence for packet in robot.voice]
        assert all(b > a for a, b in pairwise(numbers))
        assert server.noted == [(REF, "bob"), (REF, "eve")]


@on_loop
async def test_a_viewer_listens_and_does_not_talk() -> None:
    robot = SoundRobot()
    async with serving(robot) as server:
        page = server.open(Page(), role=Role.VIEWER)
        await until(lambda: page.packets)
        await page.speak(1, 3)
        await until(lambda: page.talks)
        assert page.talks == [{"talk": 1, "on": False, "why": "The role viewer may not do this"}]
        assert robot.voice == []
        assert UPLINK not in {message.topic for message in robot.published}


@on_loop
async def test_a_talk_ends_with_its_socket_and_after_a_second_without_sound(monkeypatch: pytest.MonkeyPatch) -> None:
    robot = SoundRobot()
    async with serving(robot) as server:
        bob, eve = server.open(Page(), user="bob"), server.open(Page(), user="eve")
        await bob.speak(1, 3)
        await until(lambda: bob.talks[-1:] == [{"talk": 1, "on": False, "why": "No sound came in time for 1 s"}])
        await until(lambda: server.view.talker == "")
        monkeypatch.setattr("pebble.web.media.talk.SILENT_S", 60.0)
        bob.send_piece(1, 3, bytes(PIECE_BYTES))
        await bob.speak(2, 3)
        await until(lambda: server.view.talker == "bob")
        assert [one["on"] for one in bob.talks] == [True, False, True]
        bob.leave()
        await until(lambda: server.view.talker == "")
        await eve.speak(1, 3)
        await until(lambda: eve.talks)
        assert eve.talks == [{"talk": 1, "on": True, "why": ""}]


@pytest.mark.usefixtures("patient")
@on_loop
async def test_a_talk_ends_when_the_robots_sound_is_refused() -> None:
    robot = SoundRobot()
    async with serving(robot) as server:
        page = server.open(Page(), NOTHING)
        talking = asyncio.create_task(page.speak(1, 250))
        await until(lambda: server.view and server.view.talker == "alice")
        changed = capabilities({**AUDIO, "controls": False})
        robot.transport.publish(CAPABILITIES, changed, qos=QoS.DELIVERED, retain=True)
        await talking
        await until(lambda: len(page.talks) > 1)
        assert page.talks[1:] == [{"talk": 1, "on": False, "why": "its sound cannot be switched on from here"}]
        await until(lambda: server.view.talker == "")


@on_loop
async def test_a_talk_ends_when_the_broker_takes_nothing() -> None:
    robot = SoundRobot()
    async with serving(robot) as server:
        server.broker.publish = lambda *_, **__: False  # type: ignore[method-assign]
        page = server.open(Page(), NOTHING)
        await page.speak(1, 50)
        await until(lambda: len(page.talks) > 1)
        assert page.talks[1:] == [{"talk": 1, "on": False, "why": "The server cannot reach the broker"}]


@on_loop
async def test_the_voice_goes_to_the_robots_own_topic_only() -> None:
    for named, topic in [
        (f"{REF}/incoming/voice", f"{REF}/incoming/voice"),
        ("pebble/robots/victim/incoming/audio-stream", UPLINK),
        (f"{REF}/incoming/drive-values", UPLINK),
    ]:
        robot = SoundRobot({**AUDIO, "uplink_topic": named})
        async with serving(robot) as server:
            await server.open(Page(), NOTHING).speak(1, 3)
            await until(partial(_was_published, robot, topic))
            assert all(one.topic.startswith(f"{REF}/incoming/") for one in robot.published)


def _was_published(robot: SoundRobot, topic: str) -> bool:
    return topic in {one.topic for one in list(robot.published)}


@on_loop
async def test_capabilities_that_change_end_the_request() -> None:
    robot = SoundRobot()
    async with serving(robot) as server:
        page = server.open(Page())
        await until(lambda: page.packets)
        robot.transport.publish(
            CAPABILITIES, capabilities({**AUDIO, "controls": False}), qos=QoS.DELIVERED, retain=True
        )
        await until(lambda: server.view.state == "refused")
        await until(lambda: robot.flags == [True, False])


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


def test_the_numbers_of_packets_only_grow_also_of_another_server() -> None:
    piece, numbers = bytes(PIECE_BYTES), []
    for server in range(3):
        voice = Voice()
        for talk in range(3):
            now = 1.7e9 + 100 * server + 10 * talk
            voice.begin(now)
            numbers += [Sound.unpack(voice.packet(piece, now)).sequence for _ in range(400)]
    assert all(a < b for a, b in pairwise(numbers))


def test_after_the_last_number_comes_1() -> None:
    voice = Voice()
    voice._count = 0xFFFF_FFFE
    numbers = [Sound.unpack(voice.packet(bytes(PIECE_BYTES), 1.0)).sequence for _ in range(3)]
    assert numbers == [0xFFFF_FFFF, 1, 2]
