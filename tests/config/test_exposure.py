"""What lets others read or overhear a secret is warned of, by everything that shows a config's warnings."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from pebble.config import load, parse


def written(folder: Path, mode: int, **keys: Any) -> Path:
    path = folder / "robot.json"
    path.write_text(json.dumps({"robot": {"id": "goob"}, **keys}))
    path.chmod(mode)
    return path


def warnings(**keys: Any) -> tuple[str, ...]:
    return parse({"robot": {"id": "goob"}, **keys}, folder=Path("/nowhere"), env={}).warnings


LOCAL = {"username": "ann", "password": "hunter2"}


@pytest.mark.parametrize(
    ("keys", "secret"),
    [
        ({"local_mqtt": LOCAL}, True),
        ({"services": {"av_daemon": {"video": {"device": "rtsp://me:pw@cam.example/"}}}}, True),
        ({"services": {"mqtt_bridge": {"reboot_control": {"env": {"API_KEY": "k"}}}}}, True),
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
TLS = {"tls": {"enabled": True}}
REMOTE = "services.mqtt_bridge.remote_mqtt"


def uplink(**keys: Any) -> dict[str, Any]:
    return {"services": {"mqtt_bridge": {"enabled": True, "remote_mqtt": {**FAR, **keys}}}}


@pytest.mark.parametrize(
    ("keys", "where"),
    [
        ({"local_mqtt": {"tls": {"enabled": True, "insecure": True}}}, ["local_mqtt.tls.insecure"]),
        ({"local_mqtt": {"tls": {"enabled": False, "insecure": True}}}, []),
        ({**uplink(), "local_mqtt": LOCAL}, [f"{REMOTE}.username"]),  # its password crosses the network in clear
        ({**uplink(**TLS), "local_mqtt": {**LOCAL, "host": "far"}, "transport": {"kind": "zenoh"}}, []),
        # another account with this client id would end the connection
        ({**uplink(**TLS), "security": {"level": "login"}}, [f"{REMOTE}.client_id"]),
    ],
)
def test_a_connection_that_others_can_overhear_or_end(keys: dict[str, Any], where: list[str]) -> None:
    assert [warning.partition(":")[0] for warning in warnings(**keys)] == where
