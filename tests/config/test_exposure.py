"""What lets others read or overhear a secret is warned of, by everything that shows a config's warnings."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from pebble.check_result import State
from pebble.config import load, parse
from pebble.extensions.checks.robot import run_checks


def written(folder: Path, mode: int, **keys: Any) -> Path:
    path = folder / "robot.json"
    path.write_text(json.dumps({"robot": {"id": "goob"}, **keys}))
    path.chmod(mode)
    return path


def warnings(**keys: Any) -> tuple[str, ...]:
    return parse({"robot": {"id": "goob"}, **keys}, folder=Path("/nowhere"), env={}).warnings


LOCAL = {"username": "ann", "password": "hunter2"}


@pytest.mark.parametrize(
    "keys",
    [
        {"local_mqtt": LOCAL},
        {"transport": {"kind": "x", "settings": {"token": "t"}}},
        {"services": {"av_daemon": {"video": {"device": "rtsp://me:pw@cam.example/"}}}},
        {"services": {"mqtt_bridge": {"reboot_control": {"env": {"API_KEY": "k"}}}}},
    ],
)
@pytest.mark.parametrize(("mode", "count"), [(0o644, 1), (0o640, 0), (0o600, 0)])
def test_a_config_with_a_secret_that_everybody_can_read(
    tmp_path: Path, keys: dict[str, Any], mode: int, count: int
) -> None:
    path = written(tmp_path, mode, **keys)
    fix = f"run `chmod o-rwx {path}`"
    text = f"(the whole file): every user of this machine can read it, and there is a password in it: {fix}"
    assert load(path, env={}).warnings == (text,) * count


def test_a_config_without_a_secret_may_be_read_by_everybody(tmp_path: Path) -> None:
    keys = {
        "local_mqtt": {"username": "ann", "password_env": "PW"},
        "services": {"mqtt_bridge": {"reboot_control": {"env": {"A": "b"}}}},
    }
    assert load(written(tmp_path, 0o644, **keys), env={"PW": "hunter2"}).warnings == ()


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


def test_a_connection_that_does_not_check_names() -> None:
    (warning,) = warnings(local_mqtt={"tls": {"enabled": True, "insecure": True}})
    assert warning.startswith("local_mqtt.tls.insecure: is true: ")
    assert warnings(local_mqtt={"tls": {"enabled": False, "insecure": True}}) == ()


def test_logins_that_cross_the_network_in_clear() -> None:
    login = {"username": "ann", "password": "hunter2"}
    far = {"host": "broker.example", **login}
    bridge = {"mqtt_bridge": {"enabled": True, "remote_mqtt": far}}
    (warning,) = warnings(services=bridge, local_mqtt=login)
    assert warning == (
        "services.mqtt_bridge.remote_mqtt.username: its password crosses the network unencrypted: set tls.enabled"
    )
    bridge["mqtt_bridge"]["remote_mqtt"] = {**far, "tls": {"enabled": True}}
    assert warnings(services=bridge, local_mqtt=far, transport={"kind": "zenoh"}) == ()


def test_a_client_id_by_which_another_account_ends_the_connection() -> None:
    far = {"host": "broker.example", "username": "goob", "tls": {"enabled": True}, "client_id": "goob"}
    bridge = {"mqtt_bridge": {"enabled": True, "remote_mqtt": far}}
    found = {level: warnings(services=bridge, security={"level": level}) for level in ("open", "login")}
    assert [one.partition(":")[0] for one in found["login"]] == ["services.mqtt_bridge.remote_mqtt.client_id"]
    assert not any("client_id" in one for one in found["open"])


def test_doctor_shows_them_also_for_a_board(tmp_path: Path) -> None:
    robot = {"id": "lamp", "platform": "esp8266"}
    path = written(tmp_path, 0o600, robot=robot, local_mqtt={"host": "broker.lab", **LOCAL})
    found = [finding for finding in run_checks(load(path, env={})) if finding.what == "config"]
    assert [(finding.state, finding.text.partition(":")[0]) for finding in found] == [
        (State.WARN, "local_mqtt.username")
    ]
