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


def test_connect_with_a_will_and_without_secrets() -> None:
    client = client_of(100, 200)
    assert client.send(*login(b"r-01", b"", b"", b"r/online", b"{}", 15))
    assert sent(client) == b"\x10\x1e\0\4MQTT\4\x2e\0\x0f\0\4r-01\0\x08r/online\0\2{}"


def test_connect_with_user_and_password() -> None:
    client = client_of(100, 200)
    client.send(*login(b"r", b"ann", b"geheim", b"t", b"w", 300))
    data = sent(client)
    assert data[9] == 0xEE
    assert data[10:12] == b"\x01\x2c"
    assert data.endswith(b"\0\3ann\0\6geheim")
    assert data[1] == len(data) - 2


def test_a_password_alone_comes_with_a_user_without_a_name() -> None:
    """3.1.2.9: without the user's flag there may be no password, and brokers hang up without a word."""
    client = client_of(100, 200)
    client.send(*login(b"r", b"", b"geheim", b"t", b"w", 15))
    data = sent(client)
    assert data[9] == 0xEE
    assert data.endswith(b"\0\1w\0\0\0\6geheim")


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


def test_refusals() -> None:
    for code in (1, 2, 3, 4, 5, 99):
        assert error(bytes((0x20, 2, 0, code))) == "refused by the broker: " + str(code)
    assert error(b"\x90\3\0\1\1").startswith("packet")  # fewer answers than topics


def test_each_topic_is_granted_or_refused_by_itself() -> None:
    client = subscribed()
    assert receive(client, b"\x90\4\0\1\x80\1") == ["subscribed"]
    assert bytes(client.data[client.first : client.last]) == b"\x80\1"


def test_the_account_in_a_topic_is_known() -> None:
    longest = b"a" * 32
    for rest, topic, by in (
        (b"estop", 0, ""),
        (b"drive-values", 1, ""),
        (b"control", -1, ""),  # not among the first two
        (b"by/otto/estop", 0, "otto"),
        (b"by/otto/control", 2, "otto"),
        (b"by/page-1/control/take", 3, "page-1"),
        (b"by/_/drive-values", 1, "_"),
        (b"by/" + longest + b"/control/take", 3, "a" * 32),
        (b"by/otto/control/", -1, "otto"),
        (b"by/otto/lights", -1, "otto"),
        (b"by/otto/by/otto/estop", -1, "otto"),
        (b"by/otto/", -1, "otto"),
        (b"by/" + longest + b"a/estop", 0, ""),
        (b"by//estop", 0, ""),
        (b"by/-/estop", 0, ""),
        (b"by/-a/estop", 0, ""),
        (b"by/Otto/estop", 0, ""),
        (b"by/o.t/estop", 0, ""),
        (b"by/\xc3\xb6/estop", 0, ""),
        (b"by/Otto/drive-values", -1, ""),
        (b"by/Otto/x/estop", -1, ""),
        (b"by/otto", -1, ""),
        (b"by/", -1, ""),
        (b"by", -1, ""),
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


def test_publications_of_both_qualities() -> None:
    client = client_of(200, 50)
    data = publication(b"one", first=0x30) + publication(b"two") + publication(b"three", first=0x33)
    assert receive(client, data) == [(b"one", 0), (b"two", 0), (b"three", 1)]
    assert sent(client) == b"\x40\2\x12\x34" * 2


def test_in_pieces_of_any_size() -> None:
    data = (
        b"\x20\2\0\0" + publication(b"x" * 100) + b"\xd0\0" + publication(b"") + b"\x90\4\0\1\1\1" + publication(b"z")
    )
    for step in range(1, 40):
        seen = receive(subscribed(), data, step)
        assert seen == ["welcome", (b"x" * 100, 0), "pong", (b"", 0), "subscribed", (b"z", 0)], step


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
    assert error(b"\x30\xff\xff\xff\xff\x01") == "length"
    assert error(b"\x36\x05\0\1a\0\1") == "publication"  # QoS 3
    assert error(b"\x34\x05\0\1a\0\1") == "publication"  # QoS 2
    assert error(b"\x30\x00") == "publication"
    assert error(b"\x30\x01\x00") == "publication"
    assert error(b"\x30\x03\x00\x09a") == "publication"  # a topic longer than its packet
    assert error(b"\x32\x04\x00\x01a\0") == "publication"  # half a packet id
    assert error(b"\x30\xff\x7f\x7f\xff" + b"a" * 300) == "publication"  # a topic that is not ours, longer than all
    for first in (0x00, 0x10, 0x21, 0x40, 0x50, 0x80, 0x91, 0xC0, 0xE0, 0xF0):
        assert error(bytes((first, 2, 0, 0))).startswith("packet"), first
    assert error(b"\xd0\1\0").startswith("packet")
    assert error(b"\x20\xff\x7f" + bytes(300)).startswith("packet")


def test_noise_ends_in_an_error_or_in_nothing() -> None:
    random.seed(7)
    for _ in range(300):
        client = client_of(64, 64)
        data = bytes([random.getrandbits(8) for _ in range(100)])
        try:
            while data:
                space = client.space()
                some = data[: len(space)]
                if not some:
                    break
                space[: len(some)] = some
                data = data[len(some) :]
                kind = client.take(len(some))
                while kind:
                    kind = client.take()
        except ValueError:
            pass


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
