"""What people write into a host: understood exactly, or refused with what to write; a login is never repeated."""

from __future__ import annotations

from pathlib import Path

import pytest

from pebble.config import parse
from pebble.config.hosts import HostError, broker_host, endpoint, name_of_page
from pebble.config.raw import deep_merge
from pebble.errors import ConfigError, PebbleError
from pebble.extensions.fleet.certificates import init
from pebble.extensions.operator.client.url import settings_of
from pebble.services.video_stream.config import VideoStream
from tests.kit.configs import at


@pytest.mark.parametrize(
    ("text", "host"),
    [
        *((same, same) for same in ("broker.example", "mqtt_broker", "7up", "192.0.2.7", "::1", "fe80::1%eth0", "::")),
        ("Broker.LAN.", "Broker.LAN"),
        ("[::1]", "::1"),
        *((same, "fe80::1%eth0.5") for same in ("fe80::1%25eth0.5", "[fe80::1%25eth0.5]", "[FE80::1%25eth0%2E5]")),
        ("bröker.example", "xn--brker-kua.example"),
        ("bro\u0308ker.example", "xn--brker-kua.example"),
    ],
)
def test_hosts_are_understood(text: str, host: str) -> None:
    assert broker_host(text) == host


@pytest.mark.parametrize(
    ("text", "instead"),
    [
        *((text, "must be a name or a whole address, such as") for text in (
            "mqtt://broker.example", "b:1883", "[b]", "[::1]:1883", "b/", "mqtt://u:s3/cr3t@b", "1883:s3cr3t", "1.2.3",
            "999.1.1.1", "2130706433", "0x7f.1", "010.0.0.1", "a b", "a..b", "-a", "", "u" * 64, "u." * 130, "a,b",
            "fe80::1%", "straße.example", "\uff11\uff12\uff17.0.0.1",
        )),
        ("fe80::1", 'names no network card: write "fe80::1%eth0"'),
        *((text, "starts or ends with a blank") for text in ("b ", " b")),
        *((f"b{char}", f"holds U+{ord(char):04X}, which is not shown") for char in "\t\n\0\u200b"),
    ],
)  # fmt: skip
def test_other_texts_are_refused_with_what_to_write(text: str, instead: str) -> None:
    with pytest.raises(HostError) as caught:
        broker_host(text)
    assert str(caught.value).startswith(instead)
    assert str(caught.value).isprintable()
    assert "cr3t" not in str(caught.value)


BAD = "mqtts://rover:s3cr3t@broker.example:8883"


@pytest.mark.parametrize(
    ("place", "value"),
    [
        *((f"{section}.host", BAD) for section in ("local_mqtt", "transport.mqtt_mirror", "web_interface.mqtt",
                                                   "services.mqtt_bridge.remote_mqtt", "web_interface")),
        ("web_interface.names", [BAD]),
        ("transport.listen", ["tls/rover:s3cr3t@0.0.0.0:7447"]),
    ],
)  # fmt: skip
def test_every_key_that_names_a_host_reads_it_so(place: str, value: object) -> None:
    raw = {"robot": {"id": "rover"}, "transport": {"kind": "zenoh"}}
    with pytest.raises(ConfigError) as caught:
        parse(deep_merge(raw, at(place, value)), folder=Path("/"), env={})
    assert str(caught.value).startswith(place)
    assert "s3cr3t" not in str(caught.value)


@pytest.mark.parametrize(
    "url",
    ["mqtt://rover:s3cr3t@b", "mqtt://rover:s3cr3t", "mqtt://bro\nker", "mqtt://u:s3cr3t@[::1", "tcp://u:s3cr3t@b"],
)
def test_so_does_the_command_line(url: str, tmp_path: Path) -> None:
    for read in (settings_of, lambda text: init(tmp_path, [text])):
        with pytest.raises(PebbleError) as caught:
            read(url)
        assert "cr3t" not in str(caught.value)


def test_endpoints_and_names_of_the_page() -> None:
    for text in ("tcp/0.0.0.0:0", "tls/[::]:7447?rel=1", "udp/224.0.0.224:7446#iface=eth0", "serial//dev/ttyUSB0"):
        assert endpoint(text) == text
    assert [name_of_page(name) for name in ("Fair.local:8443", "fair.local.")] == ["fair.local:8443", "fair.local"]


@pytest.mark.parametrize(
    ("url", "public", "warned"),
    [
        ("https://me:s3/cr3t@pit:88/x", "https://pit:88/x", "its login is left out"),
        ("http://pit,b/x", "http://pit,b/x", "no page can show it"),
        ("/whep", "/whep", ""),
    ],
)
def test_the_address_of_a_stream(url: str, public: str, warned: str) -> None:
    config = parse({"robot": {"id": "r"}, "services": {"video_stream": {"webrtc_url": url}}}, folder=Path("/"), env={})
    assert config.section(VideoStream).webrtc_url == public
    assert warned in "".join(config.warnings)
    assert bool(warned) == bool(config.warnings)


@pytest.mark.parametrize("section", ["services.mqtt_bridge.remote_mqtt", "local_mqtt", "web_interface.mqtt"])
def test_a_list_of_brokers_is_one_error_that_says_so(section: str) -> None:
    with pytest.raises(ConfigError) as caught:
        parse({"robot": {"id": "r"}, **at(section, {"hosts": ["a"]})}, folder=Path("/"), env={})
    (problem,) = caught.value.problems
    assert problem.startswith(f"{section}: hosts is no key any more: write host, a name that has")
