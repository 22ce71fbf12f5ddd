"""Refusals of each security level in a config; warnings of a robot without logins and of secrets others can read."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from pebble.config import load, parse
from pebble.config.raw import deep_merge
from pebble.config.rules.doors import warning_of_open
from pebble.errors import ConfigError
from tests.kit.configs import at

REMOTE, UPLINK = "services.mqtt_bridge.remote_mqtt", "services.mqtt_bridge.remote"
MIRROR, PAGE, DRIVE = "transport.mqtt_mirror", "web_interface.mqtt", "services.serial_mcu_bridge.topics.drive_values"
TLS = {"enabled": True}
ROVER = {"robot": {"id": "goob"}}
LOGIN = {"username": "goob", "tls": TLS}
GOOD: dict[str, Any] = {
    "robot": {"id": "goob"},
    "transport": {"kind": "zenoh"},
    "services": {"mqtt_bridge": {"enabled": True, "remote_mqtt": {"host": "broker.lab", **LOGIN}}},
}
MQTT: dict[str, Any] = {"transport": {"kind": "mqtt"}}


def problems(level: str, *changes: dict[str, Any]) -> list[str]:
    """Where a config is refused at this level."""
    raw = GOOD | at("security.level", level)
    for change in changes:
        raw = deep_merge(raw, change)
    try:
        parse(raw, folder=Path("/"), env={})
    except ConfigError as error:
        return [one.partition(": ")[0] for one in error.problems]
    return []


@pytest.mark.parametrize(
    ("change", "refused", "more"),
    [
        ({}, [], []),
        (at(f"{REMOTE}.tls.enabled", False), [f"{REMOTE}.tls.enabled"], []),
        (at(f"{REMOTE}.tls.insecure", True), [f"{REMOTE}.tls.insecure"], []),
        (at(REMOTE, {"host": "127.0.0.1", "tls": {"enabled": False}}), [], []),
        (at("local_mqtt.host", "10.0.0.2"), [], []),  # not used: the transport is Zenoh
        (at(MIRROR, {"host": "10.0.0.2"}), [f"{MIRROR}.tls.enabled", f"{MIRROR}.username"], [f"{MIRROR}.host"]),
        (at(MIRROR, {"host": "127.0.0.1"}), [], []),
        (at(PAGE, {"host": "broker.lab"}), [f"{PAGE}.tls.enabled", f"{PAGE}.username"], []),
        (at("transport.listen", ["tcp/0.0.0.0:7447"]), ["transport.listen"], ["transport.listen"]),
        (at("transport.listen", ["tcp/127.0.0.1:7447", "tcp/[::1]:7447"]), [], []),
        (at("transport.connect", ["udp/10.0.0.2:7447"]), ["transport.connect"], ["transport.connect"]),
        (
            at(UPLINK, {"kind": "zenoh", "connect": ["tcp/hub.lab:7447"]}),
            [f"{UPLINK}.connect", f"{UPLINK}.account"],
            [],
        ),
        (at(UPLINK, {"kind": "zenoh", "connect": ["tls/hub.lab:7447"]}), [f"{UPLINK}.account"], []),
        (at(UPLINK, {"kind": "zenoh", "connect": ["tcp/127.0.0.1:7447"]}), [], []),
        (at("services.mqtt_bridge.enabled", False), [], ["services.mqtt_bridge.enabled"]),
    ],
    ids=str,
)
def test_a_login_and_tls_are_needed_beyond_this_machine(
    change: dict[str, Any], refused: list[str], more: list[str]
) -> None:
    """``more``: what is refused at named besides."""
    assert problems("login", change) == refused
    assert problems("named", change) == refused + more
    assert problems("open", change) == []


@pytest.mark.parametrize(
    ("change", "refused"),
    [
        (at(DRIVE, "x/y"), [DRIVE]),
        (at("services.mqtt_bridge.topics.reboot", "x/y"), ["services.mqtt_bridge.topics.reboot"]),
        (at("services.serial_mcu_bridge.topics.charging_level", "x/y"), []),
        (at(MIRROR, {"host": "broker.lab", **LOGIN}), ["transport.mqtt_mirror.host"]),
        (deep_merge(MQTT, at("local_mqtt", {"host": "broker.lab", "port": 1884, **LOGIN})), ["local_mqtt.host"]),
        (deep_merge(MQTT, at("local_mqtt", {"host": "127.0.0.1"})), []),
        (deep_merge(MQTT, at(REMOTE, {"host": "localhost"})), [f"{REMOTE}.host"]),
        (deep_merge(MQTT, at(REMOTE, {"host": "localhost", "port": 1884})), []),
        (
            deep_merge(
                at("transport.connect", ["tls/hub.lab:7447", "tcp/127.0.0.1:7447"]),
                at("transport.tls", {"enabled": True, "ca_cert": "/etc/hostname"}),
            ),
            ["transport.connect"],
        ),
    ],
    ids=str,
)
def test_named_refuses_what_leads_past_the_bridge(change: dict[str, Any], refused: list[str]) -> None:
    assert problems("named", change) == refused
    assert problems("login", change) == []


def test_a_link_without_a_user_name_is_refused() -> None:
    anonymous = GOOD | {
        "services": {"mqtt_bridge": {"enabled": True, "remote_mqtt": {"host": "broker.lab", "tls": TLS}}}
    }
    with pytest.raises(ConfigError, match=f"{REMOTE}.username: is missing at security.level"):
        parse(anonymous | at("security.level", "login"), folder=Path("/nowhere"), env={})


def test_a_board_that_has_no_memory_for_tls_logs_in_without_it() -> None:
    board = {"robot": {"id": "benjr", "platform": "esp8266"}, "local_mqtt": {"host": "broker.lab", "username": "benjr"}}
    config = parse(board | at("security.level", "login"), folder=Path("/nowhere"), env={})
    assert any("its password crosses the network unencrypted" in warning for warning in config.warnings)
    del board["local_mqtt"]["username"]
    with pytest.raises(ConfigError, match="username: is missing"):
        parse(board | at("security.level", "login"), folder=Path("/nowhere"), env={})


@pytest.mark.parametrize(
    ("change", "where"),
    [
        ({}, "broker broker.lab"),
        (at("security.level", "login"), ""),
        (at(f"{REMOTE}.host", "127.0.0.1"), ""),
        (
            deep_merge(at(f"{REMOTE}.host", "127.0.0.1"), at("transport.connect", ["tcp/10.0.0.2:7447"])),
            "tcp/10.0.0.2:7447",
        ),
        (deep_merge(at(f"{REMOTE}.host", "127.0.0.1"), at(PAGE, {"host": "broker.lab"})), ""),
    ],
    ids=str,
)
def test_a_robot_that_asks_for_no_name_is_warned_of_once(change: dict[str, Any], where: str) -> None:
    warning = warning_of_open(parse(deep_merge(GOOD, change), folder=Path("/nowhere"), env={}))
    expected = f'security.level is "open": whoever may publish by {where} drives this robot (docs/ext/fleet.md)'
    assert warning == {True: expected, False: ""}[bool(where)]


@pytest.mark.parametrize(
    ("security", "unnamed"),
    [
        ({}, "free"),
        ({"strangers": "drive"}, "drive"),
        ({"level": "login"}, "free"),
        ({"level": "login", "strangers": "drive"}, "drive"),
        ({"level": "named"}, "refuse"),
        ({"level": "named", "strangers": "free"}, "free"),
    ],
)
def test_drive_commands_without_control(security: dict[str, str], unnamed: str) -> None:
    config = parse(GOOD | {"security": security}, folder=Path("/nowhere"), env={})
    assert config.security.unnamed == unnamed


# -- warnings of what lets others read or overhear a secret


def written(folder: Path, mode: int, **keys: Any) -> Path:
    path = folder / "robot.json"
    path.write_text(json.dumps(ROVER | keys))
    path.chmod(mode)
    return path


LOCAL = {"username": "ann", "password": "hunter2"}


@pytest.mark.parametrize(
    ("keys", "secret"),
    [
        ({"local_mqtt": LOCAL}, True),
        ({"services": {"av_daemon": {"video": {"device": "rtsp://me:pw@cam.example/"}}}}, True),
        ({"services": {"mqtt_bridge": {"reboot_control": {"env": {"API_KEY": "k"}}}}}, True),
        ({"transport": {"kind": "x", "settings": {"token": "t"}}}, True),
        ({"local_mqtt": {"username": "ann", "password_env": "PW"}}, False),
    ],
)
@pytest.mark.parametrize(("mode", "open_"), [(0o644, True), (0o640, False)])
def test_a_config_with_a_secret_that_everybody_can_read(
    tmp_path: Path, keys: dict[str, Any], secret: bool, mode: int, open_: bool
) -> None:
    path = written(tmp_path, mode, **keys)
    fix = f"run `chmod o-rwx {path}`"
    text = f"(the whole file): every user of this machine can read it, and there is a password in it: {fix}"
    assert load(path, env={"PW": "hunter2"}).warnings == (text,) * (secret and open_)


def test_files_of_secrets_that_everybody_can_read(tmp_path: Path) -> None:
    for name in ("password", "me.pem", "me.key", "page.pem", "page.key"):
        (tmp_path / name).write_text("x")
        (tmp_path / name).chmod(0o644)
    tls = {"enabled": True, "client_cert": "me.pem", "client_key": "me.key"}
    page = {"tls": {"certificate": "page.pem", "key": "page.key"}}
    local = {"username": "ann", "password_file": "password", "tls": tls}
    path = written(tmp_path, 0o644, local_mqtt=local, web_interface=page)
    assert [line.partition(":")[0] for line in load(path, env={}).warnings] == [
        "local_mqtt.tls.client_key",
        "local_mqtt.password_file",
        "web_interface.tls.key",
    ]
    for name in ("password", "me.key", "page.key"):
        (tmp_path / name).chmod(0o640)
    assert load(path, env={}).warnings == ()


FAR = {"host": "broker.example", "username": "goob", "password": "hunter2", "client_id": "goob"}


def uplink(**keys: Any) -> dict[str, Any]:
    return {"services": {"mqtt_bridge": {"enabled": True, "remote_mqtt": {**FAR, **keys}}}}


@pytest.mark.parametrize(
    ("keys", "where"),
    [
        ({"local_mqtt": {"tls": {"enabled": True, "insecure": True}}}, ["local_mqtt.tls.insecure"]),
        ({"local_mqtt": {"tls": {"enabled": False, "insecure": True}}}, []),
        ({**uplink(), "local_mqtt": LOCAL}, [f"{REMOTE}.username"]),  # its password crosses the network in clear
        ({**uplink(tls=TLS), "local_mqtt": {**LOCAL, "host": "far"}, "transport": {"kind": "zenoh"}}, []),
        # another account with this client id would end the connection
        ({**uplink(tls=TLS), "security": {"level": "login"}}, [f"{REMOTE}.client_id"]),
    ],
)
def test_a_connection_that_others_can_overhear_or_end(keys: dict[str, Any], where: list[str]) -> None:
    assert [
        warning.partition(":")[0] for warning in parse(ROVER | keys, folder=Path("/nowhere"), env={}).warnings
    ] == where
