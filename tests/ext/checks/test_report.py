"""``pebble doctor --report``: everything that helps is in it, and no password or key."""

from __future__ import annotations

import stat
import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from pebble.extensions.checks.report import report
from pebble.extensions.checks.report.report import make
from pebble.extensions.checks.report.secrets_here import secrets_of, values_in
from pebble.extensions.operator.places import Places
from tests.commands.command_line import Run
from tests.ext.checks.installed import BROKER, MQTT, ROBOT, config_of, installed

UNIT = "etc/systemd/system/pebble.service"
#: Files with a secret each, that an installed robot may have besides.
SENTINELS = {
    "etc/default/pebble": "MQTT_PASSWORD=sentinel-of-the-unit\n",
    "etc/NetworkManager/system-connections/hall": "[wifi-security]\nkey-mgmt=wpa-psk\npsk=sentinel of the network\n",
    "etc/wpa_supplicant/wpa_supplicant.conf": 'network={\n  ssid="hall"\n  psk="sentinel-of-wpa"\n}\n',
    "etc/ssh/ssh_host_ed25519_key": (
        "-----BEGIN OPENSSH PRIVATE KEY-----\nc2VudGluZWwtb2YtdGhlLWhvc3Qta2V5\n-----END OPENSSH PRIVATE KEY-----\n"
    ),
    "etc/pebble/other.json": '{"url": "mqtts://ann:sentinel-in-a-url@broker", "password": "sentinel-in-json"}',
    "etc/credstore/mqtt-password": "sentinel-of-systemd",
}
WORDS = [MQTT, ROBOT, "sentinel"]


@pytest.fixture
def places(tmp_path: Path) -> Iterator[Places]:
    with installed(tmp_path / "root") as one:
        unit = f'[Service]\nUser=pebble\nDescription=the word is {ROBOT}.\n# {{"a": "{ROBOT}"}}\n'
        for name, text in {UNIT: unit, **SENTINELS}.items():
            (one.root / name).parent.mkdir(parents=True, exist_ok=True)
            (one.root / name).write_text(text)
        yield one


def parts(file: Path) -> dict[str, str]:
    with zipfile.ZipFile(file) as packed:
        return {name: packed.read(name).decode() for name in packed.namelist()}


def test_what_is_in_it_and_what_is_not(places: Places, tmp_path: Path, run: Run) -> None:
    file = tmp_path / "goob.zip"
    assert run("doctor", "--report", file, "--root", places.root) == 0
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    found = parts(file)
    missing = {line.split(": ")[0] for line in found["index.txt"].splitlines() if ": MISSING: " in line}
    assert found.keys() | missing == {"index.txt", *report.PARTS}
    assert missing >= {"status.txt", "slots.txt"}  # it does not run, and has no slots
    assert '"password": "***"' in found["config.json"]
    assert 'User=pebble\nDescription=the word is ***.\n# {"a": "***"}\n' in found["units.txt"]
    assert "security: " in found["doctor.txt"]
    text = "".join(found.values()) + run.out + run.err
    assert [word for word in WORDS if word in text] == []
    assert run("doctor", "--report", file, "--root", places.root) == 2
    assert "exists: name another file" in run.err


def test_each_secret_of_the_machine_is_known(places: Places) -> None:
    known = secrets_of(places, config_of(places)).known
    wanted = {
        *(MQTT, ROBOT, "sentinel-of-the-unit", "sentinel of the network", "sentinel-of-wpa", "sentinel-of-systemd"),
        *("c2VudGluZWwtb2YtdGhlLWhvc3Qta2V5", "sentinel-in-a-url", "sentinel-in-json"),
        *_lines(places.etc / "tls/server.key"),
        *_lines(places.root / BROKER / "ca.key"),
    }
    assert wanted - known == set()


def _lines(key: Path) -> list[str]:
    """The lines of a private key that tell something."""
    return [line for line in key.read_text().splitlines() if len(line) >= 16 and "-" not in line]


@pytest.mark.parametrize(
    "written",
    [
        'sentinel "with" a/ü',
        r"sentinel \"with\" a/\u00fc",
        "sentinel%20%22with%22%20a%2F%C3%BC",
        "c2VudGluZWwgIndpdGgiIGEvw7w",
    ],
    ids=["as it is", "JSON", "address", "base64"],
)
def test_every_form_of_a_secret_is_hidden(written: str, places: Places) -> None:
    (places.etc / "odd.password").write_text('sentinel "with" a/ü')
    known = secrets_of(places, None)
    assert known.hidden(f"x{written}y, and nothing") == "x***y, and nothing"


@pytest.mark.parametrize("text", [None, '{"robot": {"id": "goob", "idd": 1}}'])
def test_a_config_with_mistakes_or_none_is_reported_as_such(text: str | None, tmp_path: Path) -> None:
    places = Places(tmp_path)
    if text is not None:
        places.config.parent.mkdir(parents=True)
        places.config.write_text(text)
    made = make(places)
    assert "robot.json" in made.missing.get("config.json", "") + made.parts.get("config.json", "")
    assert "status.txt" in made.missing
    assert "versions.txt" in made.parts


def test_what_it_may_not_read_is_named(places: Places, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(path: Path) -> bytes:
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr("pebble.extensions.checks.report.secrets_here.read_plain", refuse)
    known = secrets_of(places, None)
    assert str(places.etc / "mqtt.password") in known.unread


VALUES = [
    ("passwords", "ann:$7$101$c2FsdHNhbHRzYWx0$aGFzaGhhc2hPwd4==\n", ["c2FsdHNhbHRzYWx0", "aGFzaGhhc2hPwd4=="]),
    ("admin.password", "word-of-admin\n", ["word-of-admin"]),
    ("a.conf", "password_file /etc/mosquitto/passwd\n# password old\nremote_password word\n", ["old", "word"]),
    (
        "a.json",
        '{"password_file": "x", "password_env": "Y", "token": "word", "n": [{"api_key": "w2"}]}',
        ["word", "w2"],
    ),
    ("ca.pem", "-----BEGIN CERTIFICATE-----\nMIIB8jCCAZegAwIBAgIUW\n-----END CERTIFICATE-----\n", []),
    (
        "a.key",
        "-----BEGIN EC PRIVATE KEY-----\nMHcCAQEEIMHcCAQEEI\nAB==\n-----END EC PRIVATE KEY-----\n",
        ["MHcCAQEEIMHcCAQEEI"],
    ),
    ("robot.txt", "an ordinary text: nothing\npassword: none\n", []),
    ("run.py", "connect(user, password=None, token=token)\n", []),
]


@pytest.mark.parametrize(("name", "text", "values"), VALUES)
def test_the_secrets_in_a_file(name: str, text: str, values: list[str]) -> None:
    assert list(dict.fromkeys(values_in(name, text.encode()))) == values


def test_one_that_is_too_short_is_named_and_not_hidden(places: Places) -> None:
    (places.etc / "short.password").write_text("abc")
    known = secrets_of(places, None)
    assert known.short == (str(places.etc / "short.password"),)
    assert "abc" not in known.known
