"""Short names of topics, and addresses of connections."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from pebble.errors import PebbleError
from pebble.extensions.operator.client.named_topics import NamedTopics
from pebble.extensions.operator.client.names import Names, base_of
from pebble.extensions.operator.client.url import UrlError, settings_of
from pebble.runtime.connections import ALL_VITAL
from pebble.transports import Message, MqttSettings, QoS, ZenohSettings

GOOB, FRED = "pebble/robots/goob", "pebble/robots/fred"


@pytest.mark.parametrize(
    ("name", "filters"),
    [
        ("drive-values", [f"{GOOB}/incoming/drive-values"]),
        ("online", [f"{GOOB}/outgoing/online", f"{GOOB}/outgoing/heartbeat"]),
        ("incoming/audio", [f"{GOOB}/incoming/audio"]),
        ("outlets/o1/power", [f"{GOOB}/incoming/outlets/o1/power"]),
        ("pebble/robots/fred/outgoing/online", ["pebble/robots/fred/outgoing/online"]),
        ("house/lamp", ["house/lamp"]),
    ],
)
def test_names_to_listen_to(name: str, filters: list[str]) -> None:
    assert Names(GOOB).filters(name) == filters


def test_an_id_is_typed_in_any_form_and_names_one_topic_to_publish_to() -> None:
    assert {base_of(typed) for typed in ("bär", "ba\u0308r", "pebble/robots/ba\u0308r")} == {"pebble/robots/b\u00e4r"}
    names = Names(base_of("goob"))
    assert names.topic("audio") == f"{GOOB}/incoming/audio"
    assert names.topic("outgoing/audio") == f"{GOOB}/outgoing/audio"
    assert Names().filters("drive-values") == ["+/+/+/incoming/drive-values"]
    with pytest.raises(PebbleError, match="--robot"):
        Names().topic("drive-values")


@pytest.mark.parametrize("name", ["drive-valus", "incoming/drive-valus"])
def test_a_misspelt_name_gets_a_suggestion(name: str) -> None:
    with pytest.raises(PebbleError, match="did you mean"):
        Names(GOOB).filters(name)


# -- topics with the sender's name


MOVE, ZERO = b'{"x":0.0,"z":0.5}', b'{"x":0.0,"z":0.0}'


def topics(account: str, *named: str) -> NamedTopics:
    return NamedTopics(account, lambda base: base in named)


@pytest.mark.parametrize(
    ("account", "topic", "payload", "published"),
    [
        ("ann", f"{GOOB}/incoming/drive-values", MOVE, [f"{GOOB}/incoming/by/ann/drive-values"]),
        ("ann", f"{GOOB}/incoming/flags/mqtt-video", b"true", [f"{GOOB}/incoming/by/ann/flags/mqtt-video"]),
        ("ann", f"{GOOB}/incoming/estop", b"{}", [f"{GOOB}/incoming/estop", f"{GOOB}/incoming/by/ann/estop"]),
        ("ann", f"{GOOB}/incoming/by/bob/drive-values", MOVE, [f"{GOOB}/incoming/by/bob/drive-values"]),
        ("ann", f"{GOOB}/outgoing/online", b"{}", [f"{GOOB}/outgoing/online"]),
        ("ann", f"{FRED}/incoming/drive-values", MOVE, [f"{FRED}/incoming/drive-values"]),
        ("", f"{GOOB}/incoming/estop", b"{}", [f"{GOOB}/incoming/estop"]),
        ("", f"{GOOB}/incoming/drive-values", ZERO, [f"{GOOB}/incoming/drive-values"]),
    ],
)
def test_each_message_has_the_topic_that_its_robot_reads(
    account: str, topic: str, payload: bytes, published: list[str]
) -> None:
    forms = list(topics(account, GOOB).forms(Message(topic, payload, QoS.DELIVERED, retain=True)))
    assert [one.topic for one in forms] == published
    assert not any(one.retain for one in forms if "/by/ann/" in one.topic)
    assert {one.payload for one in forms} == {payload}


@pytest.mark.parametrize("account", ["", "Ann Smith"])
@pytest.mark.parametrize("metric", ["drive-values", "estop-reset"])
def test_without_a_name_one_line_shows_what_to_type(account: str, metric: str) -> None:
    with pytest.raises(
        PebbleError, match=r"^goob takes commands only with a name, .*: log in .* --url mqtts://"
    ) as one:
        list(topics(account, GOOB).forms(Message(f"{GOOB}/incoming/{metric}", MOVE)))
    assert "\n" not in str(one.value)


@pytest.mark.parametrize(
    ("topic", "payload", "person", "signed"),
    [
        (f"{GOOB}/incoming/lights-solid", {"r": 1}, "bob", {"r": 1, "by": "bob"}),
        (f"{GOOB}/incoming/x", {"value": {"r": 1}}, "bob", {"value": {"r": 1, "by": "bob"}}),
        (f"{GOOB}/incoming/estop", {"by": "bob on phone"}, "bob", {"by": "bob on phone"}),
        (f"{GOOB}/incoming/flags/mqtt-video", True, "bob", True),
        (f"{GOOB}/incoming/lights-solid", {"r": 1}, "", {"r": 1}),
        (f"{GOOB}/outgoing/lights", {"r": 1}, "bob", {"r": 1}),
    ],
)
def test_a_person_stands_in_what_has_room_for_it(topic: str, payload: object, person: str, signed: object) -> None:
    raw = json.dumps(payload).encode()
    assert json.loads(topics("page-1", GOOB).signed(topic, raw, person)) == signed


def test_the_clients_own_name_is_not_sent_twice() -> None:
    for claim in ("ann", "ann@desk"):
        (named,) = topics("ann", GOOB).forms(
            Message(f"{GOOB}/incoming/control", b'{"id":"1","by":"%s"}' % claim.encode())
        )
        assert json.loads(named.payload) == {"id": "1"}
    (named,) = topics("ann", GOOB).forms(Message(f"{GOOB}/incoming/control", b'{"id":"1","by":"anna"}'))
    assert json.loads(named.payload) == {"id": "1", "by": "anna"}


# -- addresses


@pytest.mark.parametrize(
    ("url", "settings"),
    [
        ("mqtt://broker", MqttSettings(host="broker")),
        ("mqtt://broker:1884/", MqttSettings(host="broker", port=1884)),
        ("mqtt://ann%40home@[::1]", MqttSettings(host="::1", username="ann@home")),
    ],
)
def test_mqtt_urls(url: str, settings: MqttSettings) -> None:
    assert settings_of(url) == ("mqtt", replace(settings, vital=ALL_VITAL))


def test_encrypted_urls_and_run_directories(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PEBBLE_PASSWORD", "secret")
    kind, settings = settings_of("mqtts://ann@broker", ca_cert=tmp_path / "ca.pem")
    assert isinstance(settings, MqttSettings)
    assert (kind, settings.port, settings.username, settings.password) == ("mqtt", 8883, "ann", "secret")
    (tmp_path / "password").write_text("geheim\n")
    file = tmp_path / "password"
    assert settings_of("mqtt://ann@broker", password_file=file)[1] == MqttSettings(
        host="broker", username="ann", password="geheim", password_file=file, vital=ALL_VITAL
    )
    assert settings.tls is not None
    assert settings.tls.ca_cert == tmp_path / "ca.pem"
    assert settings_of(f"zenoh:{tmp_path}") == ("zenoh", ZenohSettings(run_dir=tmp_path, client=True))


@pytest.mark.parametrize("url", ["mqtts://:geheim@broker", "mqtt://ann:geheim@broker:x"])
def test_a_password_in_a_url_is_refused_and_not_repeated(url: str) -> None:
    with pytest.raises(UrlError) as caught:
        settings_of(url)
    assert "geheim" not in str(caught.value)


@pytest.mark.parametrize(
    "url", ["broker", "http://broker", "mqtt://", "mqtt://broker:99999", "mqtt://broker/a/topic", "mqtt://a,b",
            "zenoh:", "zenoh:/nowhere/at/all", "zenoh:/tmp/" + 300 * "x"],
)  # fmt: skip
def test_other_urls_are_refused(url: str) -> None:
    with pytest.raises(UrlError):
        settings_of(url)
