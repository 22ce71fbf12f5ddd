"""Output and refusals of ``pebble check``; the report of ``pebble doctor``, which holds no password and no key."""

from __future__ import annotations

import json
import stat
import sys
import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from pebble.extensions.checks.check import some_of
from pebble.extensions.checks.report import report
from pebble.extensions.checks.report.report import make
from pebble.extensions.checks.report.secrets_here import secrets_of, values_in
from pebble.extensions.operator.places import Places
from tests.commands.command_line import Run, config_file
from tests.ext.checks.installed import BROKER, MQTT, ROBOT, config_of, installed
from tests.support import ROOT


@pytest.mark.parametrize("path", sorted((ROOT / "configs").glob("[!s]*.json")), ids=lambda path: path.stem)
def test_every_config_we_ship_is_right(run: Run, path: Path) -> None:
    assert run("check", path) == 0
    assert run.err == ""
    assert run.out.startswith("pebble/")
    assert max(map(len, run.out.splitlines())) <= 80


def test_names_beyond_the_first_three_are_counted() -> None:
    assert [some_of("abc"), some_of("abcd")] == ["a, b, c", "a, b, c, and 1 more"]


def test_check_reads_the_certificates(run: Run, tmp_path: Path) -> None:
    for name in ("ca.pem", "me.pem", "me.key"):
        (tmp_path / name).write_text("junk")
    tls = {"enabled": True, "ca_cert": "ca.pem"}
    bridge = {"enabled": True, "remote_mqtt": {"host": "broker.example", "tls": tls}}
    transport = {"kind": "zenoh", "tls": {"enabled": True, "client_cert": "me.pem", "client_key": "me.key"}}
    path = config_file(tmp_path, local_mqtt={"tls": tls}, transport=transport, services={"mqtt_bridge": bridge})
    assert run("check", path) == 1
    assert [line.split(": ")[2] for line in run.err.splitlines()] == [
        "transport.tls.client_cert",
        "services.mqtt_bridge.remote_mqtt.tls.ca_cert",
    ], "local_mqtt is not in use"
    assert f"remote_mqtt.tls.ca_cert: {tmp_path / 'ca.pem'} cannot be used: " in run.err


def test_it_needs_a_config(run: Run) -> None:
    assert run("check") == 2
    assert "name a config" in run.err


LONG = "u" * 100
RUN_DIR = f"transport.run_dir: {{}}/{LONG} is too long for the sockets in it, set it to a shorter path"
SOCKET = f"services.av_daemon.video.socket_path: {{}}/{LONG} is too long for a socket"


@pytest.mark.parametrize(
    ("kind", "run_dir", "devices", "problem"),
    [
        ("zenoh", LONG, {}, RUN_DIR),
        ("mqtt", "run", {"av_daemon": {"enabled": True, "video": {"socket_path": LONG}}}, SOCKET),
    ],
)
def test_check_and_up_refuse_paths_that_are_too_long(
    run: Run, tmp_path: Path, kind: str, run_dir: str, devices: dict[str, object], problem: str
) -> None:
    path = config_file(tmp_path, transport={"kind": kind, "run_dir": str(tmp_path / run_dir)}, services=devices)
    for command in ("check", "up"):
        assert run(command, path) == 1
        assert problem.format(tmp_path) in run.err
    assert not (tmp_path / LONG).exists()


def test_check_shows_links_processes_and_effective_topics_but_no_secret(run: Run, tmp_path: Path) -> None:
    remote = {"host": "broker.example", "username": "goob", "password": "hush-hush"}
    bridge = {"enabled": True, "remote_mqtt": remote, "heartbeat": {"topic": "else/where"}}
    serial = {"enabled": True, "serial": {"port": "/dev/ttyACM7"}}
    path = config_file(
        tmp_path, transport={"kind": "zenoh"}, services={"mqtt_bridge": bridge, "serial_mcu_bridge": serial}
    )
    assert run("check", path, columns=120) == 0
    for expected in ("broker.example:1883", "user goob, password ***", "/dev/ttyACM7", "else/where",
                     "zenoh_hub, serial_mcu_bridge, mqtt_bridge",
                     "incoming/drive-values", "incoming/flags/reboot"):  # fmt: skip
        assert expected in run.out
    assert "outgoing/online" not in run.out
    assert run("check", path, "--json") == 0
    assert json.loads(run.out)["services"]["mqtt_bridge"]["heartbeat"]["topic"] == "else/where"
    assert "hush-hush" not in run.out


def bridge(**settings: object) -> dict[str, object]:
    return {"services": {"mqtt_bridge": {"enabled": True, **settings}}}


@pytest.mark.parametrize(
    ("keys", "shared"),
    [
        ({}, True),
        ({"robot": {"id": "goob", "platform": "esp8266"}}, True),
        (bridge(remote_mqtt={"host": "broker.example"}), False),
        (bridge(remote_mqtt={"host": "127.0.0.1", "port": 1884}), False),
        (bridge(remote={"kind": "mqtt"}, remote_mqtt={"host": "::1"}), True),
        (bridge(remote={"kind": "zenoh", "connect": ["tcp/10.0.0.2:7447"]}), False),
        ({"transport": {"kind": "zenoh"}}, False),
        ({"transport": {"kind": "zenoh", "mqtt_mirror": {"host": "127.0.0.1"}}}, True),
    ],
)
def test_check_names_the_broker_where_others_may_pose_as_a_script(
    run: Run, tmp_path: Path, keys: dict[str, object], shared: bool
) -> None:
    assert run("check", config_file(tmp_path, **{"local_mqtt": {"host": "127.0.0.1"}, **keys}), columns=160) == 0
    assert ("anybody at broker 127.0.0.1:1883 may pose as one, or end one" in run.out) == shared


def test_check_reports_every_problem_of_every_file(run: Run, tmp_path: Path) -> None:
    wrong = {"robot": {"id": "goob", "sistem": "x"}, "local_mqtt": {"port": "x"}, "services": {"mqtt_brigde": {}}}
    path = config_file(tmp_path, **wrong)
    assert run("check", path, ROOT / "configs" / "fred.json") == 1
    assert len(run.err.splitlines()) == 3
    for named in ("robot.sistem", "local_mqtt.port", "services.mqtt_brigde"):
        assert f"pebble: robot.json: {named}" in run.err
    assert "pebble/robots/fred" in run.out


def test_check_lists_every_script_and_whether_it_runs(run: Run, tmp_path: Path) -> None:
    texts = {"apriltag-locations": "import cv3", "patrol": "", "torn": "def main(:"}
    for name, text in (texts | dict.fromkeys(("other", "own-python", "own-path"), "import cv3")).items():
        (tmp_path / "autonomy" / name).mkdir(parents=True)
        (tmp_path / "autonomy" / name / "run.py").write_text(text)
    ran, other = tmp_path / "ran", tmp_path / "autonomy" / "other"
    for file in (tmp_path / "autonomy/apriltag-locations/importlib.py", other / "sitecustomize.py"):
        file.write_text(f"open({str(ran)!r}, 'w')")
    (other / "program").write_text(f"#!/bin/sh\ntouch {ran}\n")
    (other / "program").chmod(0o755)
    (other / "script.json").write_text(json.dumps({"command": ["./program", str(other / "run.py")]}))
    scripts = {"patrol": {"python": sys.executable}, "own-python": {"python": "./autonomy/other/program"}}
    manager = {"enabled": True, "scripts": scripts | {"own-path": {"env": {"PYTHONPATH": str(other)}}}}
    assert run("check", config_file(tmp_path, services={"autonomy_manager": manager}), columns=300) == 0
    lines = [" ".join(line.split()) for line in run.out.splitlines()]
    for expected in (
        "apriltag-locations runs with /usr/bin/python3, which lacks cv3",
        f"patrol runs with {sys.executable}",
        "wheel-odometry runs, Pebble's own",
    ):
        assert f"script {expected}" in lines
    assert not ran.exists(), "a check runs nothing of a script"
    assert any(line.startswith("script torn does not run: run.py, line 1: ") for line in lines)


# -- reports


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


def test_what_is_in_it_and_what_is_not(places: Places, tmp_path: Path, run: Run) -> None:
    file = tmp_path / "goob.zip"
    assert run("doctor", "--report", file, "--root", places.root) == 0
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    with zipfile.ZipFile(file) as packed:
        found = {name: packed.read(name).decode() for name in packed.namelist()}
    missing = {line.split(": ")[0] for line in found["index.txt"].splitlines() if ": MISSING: " in line}
    assert found.keys() | missing == {"index.txt", *report.PARTS}
    assert missing >= {"status.txt", "slots.txt"}  # it does not run, and has no slots
    assert '"password": "***"' in found["config.json"]
    assert 'User=pebble\nDescription=the word is ***.\n# {"a": "***"}\n' in found["units.txt"]
    assert "security: " in found["doctor.txt"]
    text = "".join(found.values()) + run.out + run.err
    assert [word for word in WORDS if word in text] == []
    (config := tmp_path / "goob.json").touch()
    for taken, words in ((file, "exists: name another file"), (config, f": pebble doctor {config} --report {file}")):
        assert run("doctor", "--report", taken, "--root", places.root) == 2
        assert words in run.err


@pytest.mark.parametrize(
    ("section", "keys"),
    [
        ("mqtt_bridge", {"enabled": True, "reboot_control": {"command": "curl -u bob:hush-hush https://x"}}),
        ("mqtt_bridge", {"enabled": True, "reboot_control": {"comand": ["curl", "-u", "bob:hush-hush"]}}),
        ("of_another_program", {"bearer": "hush-hush", "pins": [["hush-hush"]]}),
    ],
)
def test_a_text_that_the_config_does_not_have_is_not_in_it(
    tmp_path: Path, run: Run, section: str, keys: dict[str, object]
) -> None:
    (tmp_path / "root").mkdir()
    config = config_file(tmp_path, services={section: keys, "recorder": {"enabled": False, "directory": "kept"}})
    assert run("doctor", config, "--report", tmp_path / "a.zip", "--root", tmp_path / "root") == 0
    with zipfile.ZipFile(tmp_path / "a.zip") as packed:
        text = "".join(packed.read(name).decode() for name in packed.namelist())
    assert [part in text for part in (section, "hush-hush")] == [True, False]


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
