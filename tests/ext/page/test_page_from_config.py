"""The settings of the operator page from a robot's config."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from pebble.config import load, parse
from pebble.errors import ConfigError
from pebble.extensions.page.run import settings_or_all_problems
from pebble.extensions.page.setting import WebSettings, settings_of

ROOT = Path(__file__).resolve().parents[3]
REMOTE: dict[str, Any] = {
    "services": {"mqtt_bridge": {"remote_mqtt": {"host": "broker.example", "port": 8883, "username": "goob"}}}
}


def settings(web: dict[str, Any], folder: Path = Path("/nowhere"), **more: Any) -> WebSettings:
    raw = {"robot": {"id": "goob"}, "web_interface": web, "transport": {"kind": "mqtt", "state_dir": "/state"}, **more}
    return settings_of(parse(raw, folder=folder, env={}))


def problem(web: dict[str, Any], folder: Path = Path("/nowhere"), **more: Any) -> str:
    with pytest.raises(ConfigError) as caught:
        settings(web, folder, **more)
    (found,) = caught.value.problems
    return found


def test_by_default_the_page_is_for_this_machine_and_shows_what_the_robots_broker_has() -> None:
    made = settings({}, **REMOTE)
    assert (made.host, made.port, made.login, made.certificate, made.server) == ("127.0.0.1", 8080, False, None, "")
    assert (made.broker.host, made.broker.port, made.broker.username) == ("broker.example", 8883, "goob")
    assert made.people == Path("/state/people.sqlite")


def test_a_broker_of_its_own_comes_first() -> None:
    made = settings({"mqtt": {"host": "10.0.0.1", "username": "page"}}, **REMOTE)
    assert (made.broker.host, made.broker.port, made.broker.username) == ("10.0.0.1", 1883, "page")


def test_without_any_broker_there_is_no_page() -> None:
    assert problem({}).startswith(
        "web_interface.mqtt.host: is missing, and so is services.mqtt_bridge.remote_mqtt.host"
    )


def test_a_robot_whose_own_connection_is_not_mqtt_needs_a_broker_for_the_page() -> None:
    zenoh: dict[str, Any] = {
        "services": {"mqtt_bridge": {"remote": {"kind": "zenoh", "connect": ["tcp/10.0.0.1:7447"]}}}
    }
    assert 'the robot\'s own connection is "zenoh"' in problem({}, **zenoh)
    assert settings({"mqtt": {"host": "10.0.0.1"}}, **zenoh).broker.host == "10.0.0.1"


def test_other_machines_need_a_certificate() -> None:
    found = problem({"host": "0.0.0.0"}, **REMOTE)
    assert found.startswith("web_interface.host: other machines reach 0.0.0.0, which needs a certificate and a user")
    assert "`pebble cert init`" in found
    assert "`pebble web user add`" in found


def test_users_that_cannot_be_read_hide_no_other_problem(tmp_path: Path) -> None:
    raw = {"robot": {"id": "goob"}, "web_interface": {"host": "0.0.0.0", "people": str(tmp_path)}, **REMOTE}
    with pytest.raises(ConfigError) as caught:
        settings_or_all_problems(parse(raw, folder=tmp_path, env={}))
    first, second = caught.value.problems
    assert first.startswith("web_interface.host: other machines reach 0.0.0.0")
    assert second.startswith(f"{tmp_path}: ")


def test_plain_http_for_other_machines_must_be_written_and_does_not_drive() -> None:
    made = settings({"host": "0.0.0.0", "plain_http": True}, **REMOTE)
    assert (made.login, made.certificate, made.plain_http_drive) == (True, None, False)
    assert settings({"host": "0.0.0.0", "plain_http": True, "plain_http_drive": True}, **REMOTE).plain_http_drive


def test_a_certificate_needs_its_files(tmp_path: Path) -> None:
    tls = {"certificate": "server.pem", "key": "server.key", "ca": "ca.pem"}
    web = {"host": "0.0.0.0", "tls": tls, "names": ["fair.local"], "server": "fair"}
    assert problem(web, tmp_path, **REMOTE).startswith(
        f"web_interface.tls.certificate: {tmp_path}/server.pem cannot be"
    )
    for name in tls.values():
        (tmp_path / name).write_text("x")
    made = settings(web, tmp_path, **REMOTE)
    assert (made.login, made.names, made.server) == (True, ("fair.local",), "fair")
    assert (made.certificate, made.key, made.authority) == tuple(tmp_path / name for name in tls.values())


def test_the_password_of_the_broker_is_not_shown() -> None:
    remote: dict[str, Any] = {
        "services": {"mqtt_bridge": {"remote_mqtt": {"host": "b", "username": "u", "password": "hush"}}}
    }
    assert "hush" not in repr(settings({}, **remote))


def test_a_config_of_the_original_is_refused_with_what_to_do() -> None:
    with pytest.raises(ConfigError, match=r"web_interface\.host: other machines reach 0\.0\.0\.0"):
        settings_of(load(ROOT / "tests" / "data" / "original-shaped-config.json", env={}))
