"""Texts of a config: characters that are not seen, hosts, secrets in wrong places, and files in other encodings."""

from __future__ import annotations

import json
import logging
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from pebble.config import load, parse
from pebble.config.hosts import HostError, broker_host, endpoint, name_of_page
from pebble.config.raw import deep_merge
from pebble.config.secret_text import without_secrets
from pebble.config.text_files import NotTextError, read_password, text_of
from pebble.config.visible import shown
from pebble.errors import ConfigError, PebbleError
from pebble.extensions.fleet.certificates import init
from pebble.extensions.operator.client.url import settings_of
from pebble.runtime.parent import MaskingFormatter
from pebble.services.video_stream.config import VideoStream
from tests.commands.command_line import Run
from tests.kit.configs import at
from tests.support import ROOT, some

SECRET = "s3cr3t"


def config(place: str = "", value: Any = None) -> dict[str, Any]:
    """A config that is right but for ``value`` at ``place``."""
    raw: dict[str, Any] = {
        "robot": {"id": "rover"},
        "transport": {"kind": "zenoh", "run_dir": "run", "state_dir": "state"},
        "services": {"mqtt_bridge": {"enabled": True, "remote_mqtt": {"host": "127.0.0.1", "port": 1}}},
    }
    return deep_merge(raw, at(place, value)) if place else raw


def problems(folder: Path, raw: Any) -> str:
    """What is wrong with it; "" if nothing is."""
    file = folder / "c.json"
    file.write_text(raw if isinstance(raw, str) else json.dumps(raw), encoding="utf-8")
    try:
        load(file)
    except ConfigError as error:
        return str(error)
    return ""


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    return Run(monkeypatch, capsys)


REMOTE = "services.mqtt_bridge.remote_mqtt"

#: Characters that are not seen, and places where one is at an end of a text.
UNSEEN = [*"\u200b\u00a0\ufeff\u202e\u3000\n\x00\x7f\u3164"]
PLACES = ["robot.id", f"{REMOTE}.host", f"{REMOTE}.username", f"{REMOTE}.client_id"]
ENDS = [*(("robot.id", char) for char in UNSEEN), *((place, "\u200b") for place in PLACES)]


@pytest.mark.parametrize(
    ("place", "char", "named"),
    [*((place, char, f"U+{ord(char):04X}") for place, char in ENDS), (PLACES[0], " ", "starts or ends with a blank")],
)
def test_a_character_that_is_not_seen_is_named_by_its_code(tmp_path: Path, place: str, char: str, named: str) -> None:
    for text in (f"a{char}", f"{char}a"):
        found = problems(tmp_path, config(place, text))
        assert place in found
        assert named in found


@pytest.mark.parametrize(("name", "way_out"), [("ba\u0308r", '"b\\u00e4r"'), ("..", "write another"), ("bär", "")])
def test_a_name_that_nobody_can_type_is_refused_with_what_to_write(tmp_path: Path, name: str, way_out: str) -> None:
    found = problems(tmp_path, config("robot.type", name))
    assert ("robot.type: " in found, found.count("\n"), way_out in found) == (bool(way_out), 0, True)


#: Where people put a login or a password that does not belong there.
LOGINS = {
    "a URL as host": (f"{REMOTE}.host", f"mqtt://rover:{SECRET}@192.0.2.7:1883"),
    "an @ in the password": (f"{REMOTE}.host", f"mqtt://rover:p@{SECRET}@192.0.2.7"),
    "a slash in the password": (f"{REMOTE}.host", f"mqtt://rover:p/{SECRET}@192.0.2.7"),
    "percent-encoded": (f"{REMOTE}.host", f"mqtt%3A%2F%2Frover%3A{SECRET}%40192.0.2.7"),
    "a port": (f"{REMOTE}.port", f"1883:{SECRET}"),
    "a misspelt key": (f"{REMOTE}.passwrod", SECRET),
    "a list": (f"{REMOTE}.password", [SECRET]),
    "a file's name": (f"{REMOTE}.password_file", SECRET),
    "a user": (f"{REMOTE}.username", f"rover:{SECRET}"),
    "a Zenoh endpoint": ("transport.connect", [f"tls/u:{SECRET}@h:7447"]),
    "an unknown key": (f"{REMOTE}.mqtt://u:{SECRET}@h", 1),
    "a topic": ("services.serial_mcu_bridge", {"topics": {"drive": f"mqtt://u:{SECRET}@h/x"}}),
    "a video address": ("services.video_stream", {"webrtc_url": f"http://u:{SECRET}@h/x"}),
}


def test_a_secret_is_one_wherever_it_was_put(tmp_path: Path, run: Run) -> None:
    """No command prints it, whether the config is refused or not."""
    commands = []
    for case, place in LOGINS.items():
        file = tmp_path / f"{case}.json"
        file.write_text(json.dumps(config(*place)), encoding="utf-8")
        commands += [[*words, str(file)] for words in (["check"], ["check", "--json"])]
    commands += [["doctor", file] for *_, file in some(commands, 12)]
    for words in commands:
        run(*words)
        assert run.out + run.err, words
        assert SECRET not in run.out + run.err, words


def test_a_secret_on_a_command_line_is_not_printed_again(run: Run) -> None:
    commands = [
        ["topic", "list", "--url", f"mqtt://ann:{SECRET}@127.0.0.1"],
        ["estop", f"mqtt://ann:{SECRET}@127.0.0.1", "--url", "mqtt://127.0.0.1:1"],
        ["check", f"mqtt://ann:{SECRET}@127.0.0.1"],
        ["nonsense", f"--password={SECRET}"],
        ["web", "--url", f"mqtt://ann:{SECRET}@127.0.0.1:1"],
    ]
    for words in commands:
        assert run(*words), words
        assert SECRET not in run.out + run.err, words


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("at 12:30 ann@desk stopped goob", "at 12:30 ann@desk stopped goob"),
        ("zenoh: tls/[::1]:7447", "zenoh: tls/[::1]:7447"),
        (f"mqtt://a:{SECRET}@b:1", "mqtt://***@b:1"),
        (f"x?token={SECRET}&y=1", "x?token=***&y=1"),
        (f"x?X-Sig={SECRET}&design=1", "x?X-Sig=***&design=1"),
        (f"x?key={SECRET}&code={SECRET} psk={SECRET}", "x?key=***&code=*** psk=***"),
        (f'{{"api_key": "{SECRET}", "x": 1}}', '{"api_key": "***", "x": 1}'),
        (f'{{"password" : "{SECRET}"}}', '{"password" : "***"}'),
        (f"{{'mqtt_password': '{SECRET}', 'port': 1}}", "{'mqtt_password': '***', 'port': 1}"),
        (f"""{{'password': "it's {SECRET}", 'pass': b'{SECRET}'}}""", """{'password': "***", 'pass': b'***'}"""),
        (f"X-Auth-Token: {SECRET}", "X-Auth-Token: ***"),
        (f'"{{\\"api_key\\": \\"{SECRET}\\"}}"', '"{\\"api_key\\": \\"***\\"}"'),
        (f'curl -H "Authorization: Bearer {SECRET}" x', 'curl -H "Authorization: ***" x'),
        (f'"{{\\"Cookie\\": \\"{SECRET}; b\\"}}"', '"{\\"Cookie\\": \\"***\\"}"'),
        (f"""curl -H 'Authorization: Digest username="u", response="{SECRET}"' x""", "curl -H 'Authorization: ***' x"),
        (f'{{"Authorization": "Digest username=\\"u\\", response=\\"{SECRET}\\""}}', '{"Authorization": "***"}'),
        (f"curl -u ann:{SECRET} --user=ann:{SECRET} -uann:{SECRET} x", "curl -u ann:*** --user=ann:*** -uann:*** x"),
        (f"--password {SECRET} --api-token '{SECRET} {SECRET}' --x", "--password *** --api-token '***' --x"),
        (f'MQTT_PASSWORD="{SECRET} {SECRET}" x', 'MQTT_PASSWORD="***" x'),
        (f"sshpass -p {SECRET} x; mysql -u root -p{SECRET} x", "sshpass -p *** x; mysql -u root -p*** x"),
        (f"mosquitto_pub -p 1883 -P {SECRET} -t x", "mosquitto_pub -p 1883 -P *** -t x"),
        (f"mosquitto_pub -P{SECRET} -t x", "mosquitto_pub -P*** -t x"),
        (f"curl -u 'ann:a {SECRET}' -b sid={SECRET} x", "curl -u 'ann:***' -b *** x"),
        (f"redis-cli -a {SECRET} ping; unzip -P{SECRET} a", "redis-cli -a *** ping; unzip -P*** a"),
        (f"smbclient -U ann%{SECRET} //h/s; vault login {SECRET}", "smbclient -U ann%*** //h/s; vault login ***"),
        (f"nmcli dev wifi connect N password '{SECRET}'", "nmcli dev wifi connect N password '***'"),
        (f'["nmcli", "password", "{SECRET}"]', '["nmcli", "password", "***"]'),
        (f"wpa_passphrase 'my net' {SECRET} >x", "wpa_passphrase 'my net' *** >x"),
        (f"mosquitto_passwd -b file ann {SECRET}", "mosquitto_passwd -b file ann ***"),
        (f"echo {SECRET} | sudo -S reboot", "echo ***| sudo -S reboot"),
        (f'password="a\\"b{SECRET}"; token="a""{SECRET}"', 'password="*** token="***'),
        (f"""password='it'"'"'s{SECRET}' MYSQL_PWD='ab'{SECRET} x""", "password='*** MYSQL_PWD='*** x"),
        (f'?token="aaa"{SECRET}&x=1', '?token="***&x=1'),
        (
            f"""f(password='{SECRET}', y='z'), password="{SECRET}",user="y\"""",
            """f(password='***', y='z'), password="***",user="y\"""",
        ),
        (f'["mosquitto_sub", "-P", "{SECRET}"]', '["mosquitto_sub", "-P", "***"]'),
        *[
            (text, text)
            for text in (
                "docker run --user 1000:1000 -p 80:80",
                "systemctl --no-ask-password reboot",
                "ssh -p 22 ann@h",
                "journalctl -u pebble -n 50",
                "nmcli radio wifi off; zip -r a b; curl -s http://h; redis-cli -p 6379 ping; echo 1 | sudo tee x",
                "--password-file FILE (--token-file FILE)",
            )
        ],
        (f"{{'X-API-Key': '{SECRET}', 'cookie': ''}}", "{'X-API-Key': '***', 'cookie': ''}"),
        ('{"password_file": "x", "token": ""}', '{"password_file": "x", "token": ""}'),
    ],
)
def test_only_what_is_secret_is_hidden(text: str, shown: str) -> None:
    assert without_secrets(text) == shown


TEXT = json.dumps(config(), indent=1).replace("rover", "röver")


ENCODED: list[tuple[bytes, str]] = [
    (TEXT.encode(), ""),
    (TEXT.encode("utf-8-sig"), ""),
    (TEXT.replace("\n", "\r\n").encode("utf-8-sig"), ""),
    (TEXT.encode("utf-16-be"), "is not UTF-8 at its byte"),
    (TEXT.encode("latin-1"), "is not UTF-8 at its byte 24, in line 3: save it as UTF-8"),
    (TEXT.encode() + b"\0", "is not UTF-8 at its byte"),
    (b"\n\xff", "is not UTF-8 at its byte 1, in line 2"),
]


def test_a_password_is_the_text_of_its_file_without_the_end_of_its_line(tmp_path: Path) -> None:
    (tmp_path / "password").write_text(f"{SECRET} \n")
    assert read_password(tmp_path / "password", "--password-file") == f"{SECRET} "


def test_a_file_in_another_encoding_is_understood_or_named(tmp_path: Path, run: Run) -> None:
    """Text files are read in any locale; the same function reads password files and what else people write."""
    for number, (data, _) in enumerate(ENCODED):
        (tmp_path / f"{number}.json").write_bytes(data)
    commands = [["check", str(tmp_path / f"{number}.json")] for number in range(len(ENCODED))]
    latin = {"LC_ALL": "C", "PYTHONCOERCECLOCALE": "0", "PYTHONUTF8": "0", "PYTHONIOENCODING": "utf-8"}
    command = [sys.executable, "-m", "pebble.cli", *commands[0]]
    done = subprocess.run(command, cwd=ROOT, env=os.environ | latin, capture_output=True, check=True, timeout=60)
    assert "röver" in done.stdout.decode()
    for words, (_, expected) in zip(commands, ENCODED, strict=True):
        run(*words)
        assert expected in run.out + run.err
        assert ("röver" in run.out) is not bool(expected)
        assert "Traceback" not in run.err


def test_a_sentence_repeats_no_byte_of_the_file() -> None:
    with pytest.raises(NotTextError) as caught:
        text_of(SECRET.encode() + b"\xff")
    assert SECRET not in str(caught.value)


def test_every_text_file_of_the_product_is_read_as_utf_8() -> None:
    """No file is read in another encoding, whatever the locale is."""
    rule = ["--isolated", "--preview", "--select=PLW1514", "--exclude=bench,firmware,rig"]
    command = [sys.executable, "-m", "ruff", "check", *rule, "pebble", "services", "transports"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 0, done.stdout


@pytest.mark.parametrize(
    ("text", "seen"),
    [
        ("goob\u202ebmal", "goob\\u202ebmal"),  # all after it would be drawn backwards
        ("go\u200bob\u00ad", "go\\u200bob\\u00ad"),
        ("a\U000e0041", "a\\U000e0041"),
        ("a\u3164b\u2028", "a\\u3164b\\u2028"),
        ("\x1b[2J\x1b]0;title\x07", "\\u001b[2J\\u001b]0;title\\u0007"),
        ("\x9b2J\r\x00\x7f", "\\u009b2J\\u000d\\u0000\\u007f"),
        ("\ud83d", "\\ud83d"),  # half a character
        ("robot Käfer 机器人 روبات", "robot Käfer 机器人 روبات"),
        *((word, word) for word in ("👩\u200d🚀 ❤\ufe0f", "می\u200cخو")),  # parts of what is seen
        ("no\u00a0break\tand\nlines", "no\u00a0break\tand\nlines"),
    ],
)
def test_invisible_and_steering_characters_are_shown_as_codes(text: str, seen: str) -> None:
    assert shown(text) == seen
    assert shown(f"x {text}") == f"x {seen}"
    record = logging.LogRecord("a", logging.INFO, "", 0, "%s", (text,), None)
    assert MaskingFormatter("%(message)s").format(record) == seen


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
    [
        *(
            "mqtt://rover:s3cr3t@b",
            "mqtt://rover:s3cr3t",
            "mqtt://bro\nker",
            "mqtt://u:s3cr3t@[::1",
            "tcp://u:s3cr3t@b",
        ),
        "mqtt://[fe80::1]",
    ],
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
