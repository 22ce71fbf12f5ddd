"""The MQTT client, packet by packet."""

import random

from common import names
from wifi.mqtt import Client, login

ROOT = b"pebble/robots/r/incoming/"
TOPICS = (b"estop", b"drive-values")
STOP, TOPIC = ROOT + TOPICS[0], ROOT + TOPICS[1]
CONTROL = (b"estop", b"drive-values", b"control", b"control/take")


def client_of(incoming: int, outgoing: int) -> Client:
    return Client(incoming, outgoing, ROOT, TOPICS, 2, None)


def subscribed() -> Client:
    client = client_of(160, 200)
    client.subscribe(2)
    client.sent(client.waiting)
    return client


def publication(payload: bytes, topic: bytes = TOPIC, first: int = 0x32) -> bytes:
    body = bytes((len(topic) >> 8, len(topic) & 255)) + topic + (b"\x12\x34" if first & 6 else b"") + payload
    length, head = len(body), bytes((first,))
    while length > 127:
        head += bytes((length & 127 | 128,))
        length >>= 7
    return head + bytes((length,)) + body


def receive(client: Client, data: bytes, step: int = 10000) -> list:
    """What the client sees, ``step`` bytes at a time: kinds, and (payload, retained) for publications."""
    seen = []
    while data:
        space = client.space()
        count = min(step, len(space), len(data))
        assert count, "no room"
        space[:count] = data[:count]
        data = data[count:]
        kind = client.take(count)
        while kind:
            if kind == "publication":
                seen.append((bytes(client.data[client.first : client.last]), client.retained))
            else:
                seen.append(kind)
            kind = client.take()
    return seen


def sent(client: Client) -> bytes:
    """All that goes out."""
    data = b""
    while client.waiting:
        data += bytes(client.out[: client.waiting])
        client.sent(client.waiting)
    return data


def error(data: bytes) -> str:
    try:
        receive(client_of(200, 100), data)
    except ValueError as problem:
        return str(problem)
    return ""


def test_connect() -> None:
    """3.1.2.9: without the user's flag there may be no password, and brokers hang up without a word."""
    for user, password, packet in (
        (b"", b"", b"\x10\x20\0\4MQTT\4\x2e\x01\x2c\0\4r-01\0\x08r/online\0\4will"),
        (b"ann", b"geheim", b"\x10\x2d\0\4MQTT\4\xee\x01\x2c\0\4r-01\0\x08r/online\0\4will\0\3ann\0\6geheim"),
        (b"", b"geheim", b"\x10\x2a\0\4MQTT\4\xee\x01\x2c\0\4r-01\0\x08r/online\0\4will\0\0\0\6geheim"),
    ):
        client = client_of(100, 200)
        assert client.send(*login(b"r-01", user, password, b"r/online", b"will", 300))
        assert sent(client) == packet


def test_subscribe_and_ping() -> None:
    client = Client(100, 200, b"a/", (b"estop", b"cd"), 2, None)
    client.subscribe(2)
    client.send(0xC0)
    assert sent(client) == b"\x82\x13\0\1\0\7a/estop\1\0\4a/cd\0" + b"\xc0\0"
    client = Client(100, 200, b"a/", (b"b", b"c"), 1, names)
    client.subscribe(2)
    assert sent(client) == b"\x82\x1e\0\1\0\3a/b\0\0\x08a/by/+/b\0\0\x08a/by/+/c\0"
    client.subscribe(1)
    assert sent(client) == b"\x82\x13\0\1\0\3a/b\0\0\x08a/by/+/b\0"


def test_publish_short_and_long() -> None:
    client = client_of(100, 1000)
    assert client.publish(1, b"a", b"hello")
    assert sent(client) == b"\x31\x08\0\1ahello"
    assert client.publish(0, b"a", b"x" * 300)
    assert sent(client) == b"\x30\xaf\x02\0\1a" + b"x" * 300


def test_the_account_in_a_topic_is_known() -> None:
    longest = b"a" * 32
    for rest, topic, by in (
        (b"estop", 0, ""),
        (b"drive-values", 1, ""),
        (b"control", -1, ""),  # not among the first two
        (b"by/otto/control", 2, "otto"),
        (b"by/_/drive-values", 1, "_"),
        (b"by/" + longest + b"/control/take", 3, "a" * 32),
        (b"by/otto/control/", -1, "otto"),
        (b"by/otto/by/otto/estop", -1, "otto"),
        (b"by/" + longest + b"a/estop", 0, ""),
        (b"by//estop", 0, ""),
        (b"by/-a/estop", 0, ""),
        (b"by/Otto/estop", 0, ""),
        (b"by/\xc3\xb6/estop", 0, ""),
        (b"by/Otto/drive-values", -1, ""),
        (b"by/otto", -1, ""),
        (b"", -1, ""),
    ):
        client = Client(200, 50, ROOT, CONTROL, 2, names)
        assert receive(client, publication(b"/estop", ROOT + rest)) == [(b"/estop", 0)]
        assert (client.topic, client.by) == (topic, by), rest
        assert receive(client, publication(b"", b"pebble/robots/s/incoming/" + rest)) == [(b"", 0)]
        assert (client.topic, client.by) == (-1, "")
    client = Client(200, 50, ROOT, CONTROL, 4, None)  # names are not checked
    assert receive(client, publication(b"x", ROOT + b"by/otto/estop")) == [(b"x", 0)]
    assert (client.topic, client.by) == (-1, "")


def test_packets_of_each_kind_in_pieces_of_any_size() -> None:
    data = b"\x20\2\0\0" + publication(b"x" * 100) + b"\xd0\0" + publication(b"", first=0x33) + b"\x90\4\0\1\x80\1"
    for step in range(1, 40):
        client = subscribed()
        assert receive(client, data, step) == ["welcome", (b"x" * 100, 0), "pong", (b"", 1), "subscribed"], step
        assert bytes(client.data[client.first : client.last]) == b"\x80\1", "each topic is granted or refused by itself"
        assert receive(client, publication(b"z", first=0x30), step) == [(b"z", 0)]
        assert sent(client) == b"\x40\2\x12\x34" * 2


def test_the_longest_that_fits_and_one_more() -> None:
    size = len(publication(b"x" * 1024))
    client = client_of(size, 50)
    assert receive(client, publication(b"x" * 1024), 100) == [(b"x" * 1024, 0)]
    assert receive(client, publication(b"x" * 1025) + publication(b"next"), 100) == ["too long", (b"next", 0)]
    assert sent(client) == b"\x40\2\x12\x34" * 3


def test_a_length_of_256_mb_needs_no_memory() -> None:
    client = client_of(200, 50)
    head = b"\x30\xff\xff\xff\x7f\0\x25" + TOPIC
    assert receive(client, head + b"x" * 1000) == ["too long"]
    for _ in range(100):
        assert receive(client, b"x" * 1000) == []


def test_what_no_broker_sends() -> None:
    for code in (1, 99):
        assert error(bytes((0x20, 2, 0, code))) == "refused by the broker: " + str(code)
    assert error(b"\x30\xff\xff\xff\xff\x01") == "length"
    for data in (
        b"\x34\x05\0\1a\0\1",  # QoS 2
        b"\x30\x01\x00",
        b"\x30\x03\x00\x09a",  # a topic longer than its packet
        b"\x32\x04\x00\x01a\0",  # half a packet id
        b"\x30\xff\x7f\x7f\xff" + b"a" * 300,  # a topic that is not ours, longer than all
    ):
        assert error(data) == "publication", data
    # among them fewer answers than topics
    for data in (b"\x10\2\0\0", b"\xf0\2\0\0", b"\xd0\1\0", b"\x20\xff\x7f" + bytes(300), b"\x90\3\0\1\1"):
        assert error(data).startswith("packet"), data
    random.seed(7)
    for _ in range(100):
        error(bytes([random.getrandbits(8) for _ in range(100)]))


def test_a_full_exit_takes_nothing_more_and_tears_nothing() -> None:
    client = client_of(200, 30)
    assert client.publish(0, b"a", b"0123456789")
    assert not client.publish(0, b"b", b"0123456789")
    assert client.send(0xC0)
    assert bytes(client.out[: client.waiting]) == b"\x30\x0d\0\1a0123456789\xc0\0"


def test_a_long_packet_leaves_in_pieces() -> None:
    client = client_of(200, 30)
    assert client.publish(0, b"a", b"x" * 100)
    assert not client.send(0xC0)
    assert client.waiting == 30
    client.sent(7)
    assert client.waiting == 30
    data = bytes(client.out[:30])
    assert sent(client) == b"x" * (100 - 2)
    assert data[-1:] == b"x"


def test_commands_wait_while_there_is_no_room_to_acknowledge_them() -> None:
    client = client_of(200, 7)
    data = publication(b"1") + publication(b"2")
    client.space()[: len(data)] = data
    assert client.take(len(data)) == "publication"
    assert client.take() == ""
    assert client.waiting == 4
    client.sent(4)
    assert client.take() == "publication"


def test_a_new_connection_knows_nothing_of_the_old() -> None:
    client = client_of(200, 30)
    client.publish(0, b"a", b"x" * 100)
    client.space()[:10] = b"\x30\xff\xff\x7f\0\2ab12"
    client.take(10)
    client.restart()
    assert client.waiting == 0
    assert receive(client, publication(b"new")) == [(b"new", 0)]
