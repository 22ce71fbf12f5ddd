"""Every form a payload may take on the wire, and everything that must be refused (paper A.4.5, A.8.2 to A.8.11)."""

from __future__ import annotations

import itertools
import json
import math
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace

from pebble import contract as c
from pebble.contract import CHANNELS, Channel, codec
from pebble.contract.payloads import (
    AutonomyCommand,
    ChargingLevel,
    ControlRequest,
    Drive,
    EstopCommand,
    EstopReset,
    Heartbeat,
    LightsFlash,
    LightsSolid,
    OutletCommand,
    SoundboardCommand,
    SoundboardStatus,
)
from pebble.errors import PayloadError

REFUSED = "refused"
BOOLEANS = [channel for channel in CHANNELS if channel.payload is bool]
JSON_COMMANDS = [channel for channel in CHANNELS if channel.direction == "incoming" and channel.payload is not bytes]


def refused(channel: Channel, raw: bytes) -> str:
    """The reason; the test fails when ``raw`` is accepted."""
    with pytest.raises(PayloadError) as caught:
        codec.decode(channel, raw)
    return str(caught.value)


def decoded_exactly(channel: Channel, raw: bytes) -> Any:
    try:
        return codec.decode(channel, raw)
    except PayloadError:
        return REFUSED


# -- tables

FOLLOW = b'{"action": "start", "file": "follow", "config": {"tag_id": 13, "deep": [1, {"a": null}]}}'
FOLLOWS = AutonomyCommand(action="start", file="follow", config={"tag_id": 13, "deep": [1, {"a": None}]})
NO_SWITCH = [b"1", b"null", b"[]", b'"play"', b'{"enabled": 1}', b'{"file": 3}', b'{"action": true}']
#: Commands to the soundboard, and their fields.
SOUNDS: dict[bytes, dict[str, Any]] = {
    b"true": {"enabled": True},
    b"false": {"enabled": False},
    b'{"action": "play", "file": "a.wav"}': {"action": "play", "file": "a.wav"},
    b'{"enabled": true, "file": "a.wav"}': {"enabled": True, "file": "a.wav"},
    b'{"value": true, "file": "a.wav"}': {"enabled": True, "file": "a.wav"},
    b'{"value": {"action": "play", "file": "b"}, "file": "a"}': {"action": "play", "file": "b"},
    b'{"value": {"action": "play"}, "file": "a.wav"}': {"action": "play", "file": "a.wav"},
    b'{"action": "stop", "timestamp": 1.5e9}': {"action": "stop"},
    b'{"action": "play", "file": "a.wav", "repeat": true}': {"action": "play", "file": "a.wav", "repeat": True},
    b'{"value": true, "file": "b", "repeat": 3}': {"enabled": True, "file": "b", "repeat": 3},
}
#: What a payload means.
MEANINGS: list[tuple[Channel, bytes, Any]] = [
    # white space may follow a value: a bridge's probe on a flag's topic is the flag's value
    (c.MQTT_VIDEO, b'{"value": true}' + b" \t\n" * 8, True),
    (c.MQTT_VIDEO, b"true", True),
    (c.MQTT_VIDEO, b'{"value": 1, "enabled": false}', False),
    *(
        (c.OUTLET_COMMAND, raw, OutletCommand(on=True))
        for raw in (b'{"on": true}', b'{"value": {"on": true}, "on": 1}')
    ),
    # drive values, whose numbers are read below
    (c.DRIVE, b'{"x": 1, "t": 1710969600123, "origin": {"a": [1]}}', Drive(x=1, t=1710969600123)),
    # their source, their run, and how long they are valid
    (c.DRIVE, b'{"z": 1, "source": "autonomy", "run": 17}', Drive(z=1, source="autonomy", run=17)),
    (c.DRIVE, b'{"z": 1, "source": "joystick", "valid_ms": 400}', Drive(z=1, source="joystick", valid_ms=400)),
    (c.DRIVE, b'{"z": 1, "source": null, "run": null, "valid_ms": null}', Drive(z=1)),
    (c.DRIVE, b'{"z": 1, "valid_ms": 250.9}', Drive(z=1, valid_ms=250)),
    (c.DRIVE, b'{"z": 1, "key": "0badf00d", "by": "otto"}', Drive(z=1, key="0badf00d", by="otto")),
    (c.DRIVE, b'{"z": "1", "key": "0badf00d", "t": 1, "group": true}', Drive(z=1, key="0badf00d", t=1, group=True)),
    (c.DRIVE, b'{"z": 1, "key": null, "t": -1, "by": 5, "group": "a"}', Drive(z=1)),
    (c.DRIVE, b'{"z": 0, "valid_ms": 0}', Drive(valid_ms=0)),
    (c.DRIVE, b'{"z": 0, "key": 5}', Drive()),
    (c.DRIVE, b'{"value": {"z": 1, "source": "autonomy", "run": 17}}', Drive(z=1, source="autonomy", run=17)),
    (c.DRIVE, b'{"x": 123456789012345678901234567890}', Drive(x=1)),
    # brackets in strings and side by side are not depth
    (c.DRIVE, json.dumps({"x": 1, "k": '\\"[{' * 100, "wide": [[]] * 100}).encode(), Drive(x=1)),
    # lights are clamped, missing colours are dark, and what is no period is the usual one
    (c.LIGHTS_SOLID, b'{"b": 2, "g": -1}', LightsSolid(b=1.0, g=0.0, r=0.0)),
    (c.LIGHTS_SOLID, b'{"value": {"r": 0.5}}', LightsSolid(r=0.5)),
    (c.LIGHTS_FLASH, b'{"b": 1, "period": 0}', LightsFlash(b=1.0, period=0.05)),
    (c.LIGHTS_FLASH, b'{"period": "3"}', LightsFlash(period=3.0)),
    (c.LIGHTS_FLASH, b'{"period": "fast"}', LightsFlash(period=2.0)),
    (c.LIGHTS_FLASH, b'{"period": [], "b": "no"}', LightsFlash(period=2.0)),
    # a soundboard command is a boolean or an object
    *((c.SOUNDBOARD_COMMAND, raw, SoundboardCommand(**fields)) for raw, fields in SOUNDS.items()),
    (c.AUTONOMY_COMMAND, b"false", AutonomyCommand(enabled=False)),
    # a stop is one whatever else is wrong in it
    (c.AUTONOMY_COMMAND, b'{"action": "Stop", "config": "", "file": 5}', AutonomyCommand(action="Stop")),
    (c.AUTONOMY_COMMAND, b'{"enabled": false, "by": 5}', AutonomyCommand(enabled=False)),
    (c.SOUNDBOARD_COMMAND, b'{"action": "off", "enabled": 1, "repeat": "x"}', SoundboardCommand(action="off")),
    (c.AUTONOMY_COMMAND, FOLLOW, FOLLOWS),
    (c.AUTONOMY_COMMAND, b'{"value": ' + FOLLOW + b"}", FOLLOWS),
    (c.ESTOP_RESET, b'{"boot": "a1b2c3d4", "count": 3}', EstopReset(boot="a1b2c3d4", count=3)),
    (c.AUDIO_STREAM, b"PBAT\xff\x00", b"PBAT\xff\x00"),  # it is not looked into
]


@pytest.mark.parametrize(("channel", "raw", "value"), MEANINGS)
def test_a_payload_has_its_value(channel: Channel, raw: bytes, value: Any) -> None:
    assert codec.decode(channel, raw) == value


#: Payloads that mean nothing.
REFUSALS: dict[Channel, list[bytes]] = {
    c.REBOOT: [b"1", b'"true"', b"{}", b'{"value": 1}', b'{"enabled": "on"}', b'{"value": {"value": true}}', b"",
               b"null", b"[true]", b'{"on": true}', b"TRUE", b"true false"],
    c.DRIVE: [b"", b"null", b"[]", b"1", b"true", b'"x"', b'{"x": 1', b'{"x": 1}}'],
    c.ONLINE: [b'{"t": ' + b"9" * 400 + b"}", b'{"t": -' + b"9" * 400 + b"}", b'{"t": NaN}'],
    c.OUTLET_COMMAND: [b"true", b"{}", b'{"on": 1}', b'{"value": {"on": null}}'],
    c.LIGHTS_FLASH: [b'{"period": 1e999}', b'{"b": 1, "period": "inf"}', b"[1, 1, 1]", b'"1"'],
    c.SOUNDBOARD_COMMAND: [
        *(b'{"action": "play", "file": "a", "repeat": ' + number + b"}" for number in (b"-1", b'"yes"', b"0.5", b"[]")),
        *NO_SWITCH,
    ],
    c.AUTONOMY_COMMAND: NO_SWITCH,
    c.ESTOP: [b""],
    c.ESTOP_RESET: [b"", b"{}", b'{"boot": "a"}', b'{"boot": 1, "count": 1}', b'{"boot": "a", "count": true}'],
    c.CONTROL: [
        *(b"{}", b'{"id": ""}', b'{"id": "3f2a91c"}', b'{"id": "3f2a91c0\\n"}', b'{"id": 1}', b'{"id": "3f2a91cg"}'),
        *(b'{"id": "3f2a91c0", "want": "drive"}', b'{"id": "3f2a91c0", "for_ms": "1"}', b'{"id": "3f2a91c0", "by": 1}'),
    ],
}  # fmt: skip


@pytest.mark.parametrize(("channel", "raw"), [(channel, raw) for channel, raws in REFUSALS.items() for raw in raws])
def test_a_payload_without_a_value_is_refused(channel: Channel, raw: bytes) -> None:
    assert channel.metric in refused(channel, raw)


@pytest.mark.parametrize(
    ("key", "fields"),
    [
        *(("source", f'"source": {wrong}') for wrong in ("5", '["autonomy"]')),
        ("run", '"source": "autonomy"'),
        *(("run", f'"source": "autonomy", "run": {wrong}') for wrong in ('"17"', "1.5", "true", "0", "1073741824")),
        *(("valid_ms", f'"valid_ms": {wrong}') for wrong in ("0", "0.5", '"400"', "-1", "true", "1e300", 10**300)),
    ],
)
def test_a_wrong_field_refuses_a_command_that_moves_and_never_a_stop(key: str, fields: str) -> None:
    assert key in refused(c.DRIVE, f'{{"z": 0.5, {fields}}}'.encode())
    assert not codec.decode(c.DRIVE, f'{{"z": 0, {fields}}}'.encode()).moves


VECTORS = json.loads((Path(__file__).parents[1] / "vectors" / "commands.json").read_text())  # boards read the same


@pytest.mark.parametrize(("text", "number"), VECTORS["numbers"])
def test_numbers_may_be_text_and_what_is_none_is_0_but_nan_and_infinity_refuse_the_command(
    text: str, number: float | None
) -> None:
    for name, wrapper in itertools.product("xzy", ("{}", '{{"value": {}}}')):
        raw = wrapper.format(f'{{"x": 0.25, "z": 0.25, "y": 0.25, "{name}": {text}}}').encode()
        wanted = REFUSED if number is None else replace(Drive(x=0.25, z=0.25, y=0.25), **{name: number})
        assert decoded_exactly(c.DRIVE, raw) == wanted
    for name, low in (("b", 0.0), ("g", 0.0), ("r", 0.0)):
        raw = f'{{"b": 0.25, "g": 0.25, "r": 0.25, "{name}": {text}}}'.encode()
        colour = replace(LightsSolid(b=0.25, g=0.25, r=0.25), **{name: max(low, number or 0.0)})
        assert decoded_exactly(c.LIGHTS_SOLID, raw) == (REFUSED if number is None else colour)


COMMANDS = {
    c.DRIVE: ['{"x":0,"z":0}', '{"value":{"z":0.5}}', "{}"],
    c.ESTOP: ['{"stop":"c9a9f10cc9a9f10c","by":"eve"}'],
    c.CONTROL: ['{"id":"3f2a91c0","by":"ann"}', '{"value":{"id":"3f2a91c0","want":"release"}}'],
    c.LIGHTS_SOLID: ['{"b":0,"g":0,"r":0}'],
    c.AUTONOMY_COMMAND: ["false", '{"value":{"action":"stop"}}'],
    c.AUDIO_CONTROL: ["false"],
    c.ONLINE: ['{"t":1,"online":false}'],
    **{channel: ["false", '{"value":false}'] for channel in BOOLEANS},
}


@pytest.mark.parametrize(("before", "after"), VECTORS["around"])
def test_bytes_around_a_payload_change_nothing(before: str, after: str) -> None:
    for channel, texts in COMMANDS.items():
        for text in texts:
            raw = before.encode("latin-1") + text.encode() + after.encode("latin-1")
            assert codec.decode(channel, raw) == codec.decode(channel, text.encode()), channel.metric


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-le"])
def test_utf_16_is_refused_with_the_reason_and_an_emergency_stop_in_it_stops(encoding: str) -> None:
    assert "send UTF-8" in refused(c.DRIVE, '{"x":0,"z":0}'.encode(encoding))
    assert "send UTF-8" in refused(c.REMOTE_MIRROR, "false".encode(encoding))
    assert codec.decode(c.ESTOP, '{"stop":"c9a9f10cc9a9f10c"}'.encode(encoding)) == EstopCommand()


@pytest.mark.parametrize("raw", [b"\0", b"\xef\xbb\xbf"])
def test_bytes_without_a_payload_are_neither_empty_nor_a_bridges_probe(raw: bytes) -> None:
    refused(c.REMOTE_MIRROR, raw)
    assert not codec.is_blank(raw)
    assert codec.decode(c.ESTOP, raw) == EstopCommand()


@pytest.mark.parametrize(
    ("raw", "sender", "words"),
    [
        (b'{"linear":{"x":0.5,"y":0,"z":0},"angular":{"z":1}}', "", "'linear', 'angular'"),
        (b'{"left":1,"right":1,"source":"joy"}', "joy", "'left', 'right', 'source'"),
        (b'{"value":{"speed":1,"source":"joy"},"z":1}', "joy", "'speed'"),
        (b"{}", "", "but nothing"),
        (b'{"' + b"k" * 60_000 + b'":1}', "", "'kkkk"),
        (b'{"x\\u0000":1,"\\u001b[2J":1}', "", r"'\x1b[2J'"),
        (b'{"x":"' + b"9!" * 30_000 + b'"}', "", "x is '9!9!"),
        (b'{"x":true}', "", "x is a boolean"),
        (b'{"x":"0,5","z":0.5}', "", "x is '0,5', which is no number: it counts as 0"),
        *(
            (raw, None, "")
            for raw in (b'{"x":0}', b'{"z":0.5}', b'{"y":0}', b'{"\\u0078":0}', b'{"x":null}', b'{"z":"0"}')
        ),
    ],
)
def test_a_drive_command_that_may_not_mean_what_it_does_is_remarked_upon(
    raw: bytes, sender: str | None, words: str
) -> None:
    """A command that names an axis, and numbers, needs no remark."""
    remarks: list[tuple[Channel, str, str]] = []
    command = codec.decode(c.DRIVE, raw, lambda *remark: remarks.append(remark))
    assert not command.moves or command == Drive(z=0.5)
    assert [remark[:2] for remark in remarks] == ([] if sender is None else [(c.DRIVE, sender)])
    for _, _, text in remarks:
        assert words in text
        assert len(text) < 300
        assert text.isprintable()


# -- limits that hold for every command


UNREADABLE = [
    b"\xff",
    b'{"k": "\xff"}',
    b'{"k": "\xed\xa0\x80"}',
    b'{"\xc0\xaf": 1}',
    b'{"\\udc00": 1}',
    b'\xef{"x": \xbb1}',
    b'{"k": NaN}',
    b'{"k": 1e999}',
    b'{"k": ' + b"9" * 5000 + b"}",
    b"[" * 60_000,
    b" \t\n" * 8,  # by such payloads bridges look for cycles
]


@pytest.mark.parametrize("channel", [one for one in JSON_COMMANDS if one is not c.ESTOP], ids=lambda one: one.metric)
def test_invalid_json_is_refused_even_in_keys_that_are_not_read(channel: Channel) -> None:
    for raw in UNREADABLE:
        assert refused(channel, raw).startswith(channel.metric)


#: A stop, and what it means: one that cannot be read, or whose name is none, has none.
STOPS: list[tuple[bytes, EstopCommand]] = [
    *((raw, EstopCommand()) for raw in (*UNREADABLE, b"stop", b"x" * 100_000)),
    *((raw, EstopCommand(by="", why="")) for raw in (b"null", b"[]", b"true")),
    *(
        (json.dumps({"stop": name, "by": "eve"}).encode(), EstopCommand(by="eve", why=""))
        for name in ("", "stop", "c9a9f10c", "c9a9f10cc9a9f10g", "c9a9f10cc9a9f10c0", 5, None, ["c9a9f10cc9a9f10c"])
    ),
    (
        json.dumps({"value": {"stop": "c9a9f10cc9a9f10c", "by": "e\x1b[2J" + "e" * 99, "why": 'w"' * 50}}).encode(),
        EstopCommand(stop="c9a9f10cc9a9f10c", by=("e?[2J" + "e" * 99)[:32], why="w?" * 20),
    ),
]


@pytest.mark.parametrize(("raw", "stop"), STOPS)
def test_any_payload_is_a_stop(raw: bytes, stop: EstopCommand) -> None:
    assert codec.decode(c.ESTOP, raw) == stop


@pytest.mark.parametrize(
    ("raw", "request_"),
    [
        (b'{"want": "hold", "id": "3f2a91c0"}', ControlRequest(id="3f2a91c0")),
        (b'{"id": "3F2A91C0", "for_ms": 10000}', ControlRequest(id="3F2A91C0", for_ms=10_000)),
        (b'{"id": "3f2a91c0", "by": "page-1/Ann B."}', ControlRequest(id="3f2a91c0", by="page-1/ann_b_")),
        (b'{"id": "3f2a91c0", "device": "' + b"p" * 50 + b'"}', ControlRequest(id="3f2a91c0", device="p" * 20)),
    ],
)
def test_a_request_for_control_is_within_limits(raw: bytes, request_: ControlRequest) -> None:
    assert codec.decode(c.CONTROL, raw) == codec.decode(c.CONTROL_TAKE, raw) == request_


@pytest.mark.parametrize("raw", [b"[" * 60_000, b'{"x":' * 9_000 + b"1" + b"}" * 9_000])
def test_a_payload_nested_too_deep_is_refused_and_stops(raw: bytes) -> None:
    assert "nested too deep" in refused(c.DRIVE, raw)
    assert codec.decode(c.ESTOP, raw) == EstopCommand()


def test_a_command_has_at_most_64_kb() -> None:
    start, end = b'{"x": 1, "k": "', b'"}'
    fits = start + b"a" * (64 * 1024 - len(start) - len(end)) + end
    assert codec.decode(c.DRIVE, fits) == Drive(x=1)
    assert "65537 bytes" in refused(c.DRIVE, fits.replace(b"aa", b"aaa", 1))


def test_messages_of_a_robot_may_be_larger() -> None:
    files = json.dumps({"files": ["a" * 100] * 1000, "timestamp": 1.0}).encode()
    assert len(files) > 64 * 1024
    assert len(codec.decode(c.SOUNDBOARD_FILES, files).files) == 1000


# -- what we say


SIGNED = Drive(x=-0.25, z=0.625, source="autonomy", run=1_000_000, valid_ms=400)
#: What is sent: absent fields are not written, and a name that is no UTF-8 is written with its codes.
ENCODED: list[tuple[Channel, Any, bytes]] = [
    (c.AUDIO, bytearray(b"PBAT"), b"PBAT"),
    (c.ONLINE, Heartbeat(t=1, online=False), b'{"t":1,"online":false}'),
    (c.MQTT_VIDEO, True, b'{"value":true}'),
    (c.CHARGING_LEVEL, ChargingLevel(value=7.4), b'{"value":7.4,"unit":"v"}'),
    (c.DRIVE, SIGNED, b'{"x":-0.25,"z":0.625,"y":0.0,"source":"autonomy","run":1000000,"valid_ms":400}'),
    (c.SOUNDBOARD_COMMAND, SoundboardCommand(repeat=2), b'{"action":null,"enabled":null,"file":null,"repeat":2}'),
]


@pytest.mark.parametrize(("channel", "value", "raw"), ENCODED)
def test_encoding_spells_the_wire_form(channel: Channel, value: Any, raw: bytes) -> None:
    assert codec.encode(channel, value) == raw


def test_what_is_sent_is_short_and_utf_8() -> None:
    assert len(b"pebble/robots/minilamp/incoming/drive-values" + codec.encode(c.DRIVE, SIGNED)) < 256, "for a sketch"
    state = SoundboardStatus(playing=True, timestamp=1.5, file="caf\udce9 ö.wav")
    assert json.loads(codec.encode(c.SOUNDBOARD_STATUS, state))["file"] == "caf\\udce9 ö.wav"


@pytest.mark.parametrize("number", [math.nan, math.inf, -math.inf])
def test_nothing_that_is_no_number_can_be_published(number: float) -> None:
    for make in (lambda: Drive(x=number), lambda: ChargingLevel(value=number), lambda: LightsFlash(period=number)):
        with pytest.raises(ValueError, match="finite"):
            make()
