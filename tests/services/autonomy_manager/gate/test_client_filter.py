"""What a client of the gate sends is forwarded byte by byte, except what drives, and what it may not publish."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pebble.services.autonomy_manager.gate.client_filter import ClientFilter, DriveCommand, Login
from pebble.services.autonomy_manager.gate.packets import MAX_PACKET
from pebble.services.autonomy_manager.gate.topics import TopicRules
from tests.services.autonomy_manager.gate.mqtt_bytes import (
    BASE,
    DISCONNECT,
    DRIVE,
    PINGREQ,
    connect,
    packet,
    puback,
    pubcomp,
    publish,
    pubrec,
    pubrel,
    subscribe,
)

RESET = f"{BASE}/incoming/estop-reset"


def new_filter(broker: Login | None = None) -> ClientFilter:
    return ClientFilter(TopicRules(frozenset({DRIVE})), Login(b"script", b"right"), broker or Login())


def connected() -> ClientFilter:
    client = new_filter()
    assert client.feed(connect()).refusal is None
    return client


def test_the_login_at_the_broker_is_the_robots_or_none() -> None:
    client = new_filter(Login(b"robot", b"secret"))
    output = client.feed(connect(client_id="follow"))
    assert bytes(output.upstream) == connect("robot", "secret", client_id="follow")
    assert client.connected
    assert bytes(new_filter().feed(connect(client_id="follow")).upstream) == connect(None, None, client_id="follow")


@pytest.mark.parametrize(
    ("user", "password"), [("script", "wrong"), ("robot", "right"), (None, None), ("script", None)]
)
def test_a_wrong_login_is_refused(user: str | None, password: str | None) -> None:
    client = new_filter()
    output = client.feed(connect(user, password) + publish(DRIVE, '{"z":1}'))
    assert bytes(output.answers) == b"\x20\x02\x00\x04"
    assert output.refusal is not None
    assert (bytes(output.upstream), output.drive, client.connected) == (b"", [], False)
    assert new_filter().feed(publish(DRIVE, '{"z":1}')).refusal == "the first packet is no CONNECT"


@pytest.mark.parametrize(
    ("level", "answer"), [(5, b"\x20\x03\x00\x84\x00"), (3, b"\x20\x02\x00\x01"), (0x84, b"\x20\x02\x00\x01")]
)
def test_other_versions_of_mqtt_get_their_own_refusal(level: int, answer: bytes) -> None:
    output = new_filter().feed(connect(level=level))
    assert bytes(output.answers) == answer
    assert "only MQTT 3.1.1" in str(output.refusal)


@pytest.mark.parametrize(("topic", "stays"), [(DRIVE, False), (RESET, False), ("bye", True)])
def test_a_will_that_drives_is_left_out(topic: str, stays: bool) -> None:
    output = new_filter().feed(connect(will=(topic, '{"z":1}'), will_retain=True, client_id="c"))
    will: dict[str, Any] = {"will": (topic, '{"z":1}'), "will_retain": True} if stays else {}
    assert bytes(output.upstream) == connect(None, None, client_id="c", **will)


@pytest.mark.parametrize(("qos", "answer"), [(0, b""), (1, puback(7)), (2, pubrec(7))])
def test_a_drive_command_is_taken_out_and_acknowledged(qos: int, answer: bytes) -> None:
    output = connected().feed(publish(DRIVE, '{"z":1}', qos, 7, retain=True))
    assert output.drive == [DriveCommand(DRIVE, b'{"z":1}', repeated=False)]
    assert (bytes(output.upstream), bytes(output.answers)) == (b"", answer)


def test_qos_2_is_completed_without_the_broker_and_counts_once() -> None:
    client = connected()
    client.feed(publish(DRIVE, '{"z":1}', 2, 7))
    again = client.feed(publish(DRIVE, '{"z":1}', 2, 7, dup=True))
    assert (again.drive, bytes(again.answers)) == ([], pubrec(7))
    assert bytes(client.feed(pubrel(7)).answers) == pubcomp(7)
    assert bytes(client.feed(pubrel(7)).upstream) == pubrel(7), "the second one is the broker's"
    sent = publish("other", "x", 2, 8) + pubrel(8)
    output = client.feed(sent)
    assert (bytes(output.upstream), bytes(output.answers)) == (sent, b""), "of what the broker has"


@pytest.mark.parametrize(
    "topic",
    [
        RESET,
        f"{BASE}/outgoing/estop/serial",
        f"{BASE}/incoming/autonomy-command",
        "pebble/robots/fred/incoming/drive-values",
        "pebble/robots/fred/incoming/estop-reset",
        f"{BASE}/incoming/by/anna/drive-values",
    ],
)
def test_what_a_script_may_not_publish_is_acknowledged_and_dropped(topic: str) -> None:
    output = connected().feed(publish(topic, '{"z":1}', 1, 3))
    assert (bytes(output.upstream), bytes(output.answers), output.drive) == (b"", puback(3), [])
    assert output.refused_topics == [topic]


@pytest.mark.parametrize(
    "topic", [f"{BASE}/incoming/estop", f"{BASE}/outgoing/drive-values", "drive-values", "a/b", "x"]
)
def test_everything_else_is_forwarded(topic: str) -> None:
    sent = publish(topic, "{}", 1, 3, retain=True)
    assert bytes(connected().feed(sent).upstream) == sent


@pytest.mark.parametrize(
    ("malformed", "reason"),
    [
        (connect(), "second CONNECT"),
        (packet(0x36, b"\x00\x01a\x00\x01"), "QoS 3"),
        (packet(0x32, b"\x00\x01a\x00\x00"), "packet id 0"),
        (packet(0x30, b"\x00\x05a"), "inside a field"),
        (b"\x30\xff\xff\xff\xff\x01", "four bytes"),
        (packet(0x30, bytes(MAX_PACKET))[:10], "more than 262144"),
    ],
)
def test_what_is_malformed_ends_the_connection_after_what_came_before(malformed: bytes, reason: str) -> None:
    output = connected().feed(publish(DRIVE, "{}") + PINGREQ + malformed)
    assert reason in str(output.refusal)
    assert [command.payload for command in output.drive] == [b"{}"], "a zero is never lost"
    assert bytes(output.upstream) == PINGREQ


@given(st.binary(max_size=200), st.booleans())
def test_garbage_is_refused_or_forwarded_and_never_raises(garbage: bytes, logged_in: bool) -> None:
    client = connected() if logged_in else new_filter()
    output = client.feed(garbage)
    assert len(output.upstream) <= len(garbage) + 20


_publishes = st.builds(
    publish,
    st.sampled_from([DRIVE, "other", f"{BASE}/incoming/estop"]),
    st.sampled_from(['{"z":1}', "{}", "", "\x00", "[" * 200]),
    st.integers(0, 2),
    st.integers(1, 65535),
    retain=st.booleans(),
)


@settings(max_examples=60)
@given(st.lists(st.one_of(_publishes, st.just(PINGREQ), st.just(subscribe("#")))), st.integers(1, 40))
def test_fragments_of_any_size_give_the_same(packets: list[bytes], step: int) -> None:
    stream, client, upstream, drive = b"".join(packets) + DISCONNECT, connected(), bytearray(), list[DriveCommand]()
    for at in range(0, len(stream), step):
        output = client.feed(stream[at : at + step])
        upstream += output.upstream
        drive += output.drive
    drives = [sent for sent in packets if DRIVE.encode() in sent]
    assert bytes(upstream) == b"".join(sent for sent in packets if sent not in drives) + DISCONNECT
    assert len(drive) <= len(drives)
    assert connected().feed(stream).drive == drive
