"""The settings of the operator page from a robot's config."""

from __future__ import annotations

import re
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


ZENOH: dict[str, Any] = {"services": {"mqtt_bridge": {"remote": {"kind": "zenoh", "connect": ["tcp/10.0.0.1:7447"]}}}}
OPEN = {"host": "0.0.0.0", "plain_http": True}
#: Of the config its section for the page and what else there is, and fields of the settings.
SETTINGS: list[tuple[dict[str, Any], dict[str, Any], dict[str, Any]]] = [
    ({}, REMOTE, {"host": "127.0.0.1", "port": 8080, "login": False, "certificate": None, "server": ""}),
    ({}, REMOTE, {"people": Path("/state/people.sqlite")}),
    ({}, REMOTE, {"broker": ("broker.example", 8883, "goob")}),
    ({"mqtt": {"host": "10.0.0.1", "username": "page"}}, REMOTE, {"broker": ("10.0.0.1", 1883, "page")}),
    ({"mqtt": {"host": "10.0.0.1"}}, ZENOH, {"broker": ("10.0.0.1", 1883, None)}),
    (OPEN, REMOTE, {"login": True, "certificate": None, "plain_http_drive": False}),
    (OPEN | {"plain_http_drive": True}, REMOTE, {"plain_http_drive": True}),
]


@pytest.mark.parametrize(("web", "more", "expected"), SETTINGS)
def test_settings(web: dict[str, Any], more: dict[str, Any], expected: dict[str, Any]) -> None:
    made = settings(web, **more)
    broker = made.broker.host, made.broker.port, made.broker.username
    assert {key: broker if key == "broker" else getattr(made, key) for key in expected} == expected


@pytest.mark.parametrize(
    ("web", "more", "words"),
    [
        ({}, {}, r"^web_interface\.mqtt\.host: is missing, and so is services\.mqtt_bridge\.remote_mqtt\.host"),
        ({}, ZENOH, 'the robot\'s own connection is "zenoh"'),
        ({"host": "0.0.0.0"}, REMOTE, "needs a certificate and a user.*`pebble cert init`.*`pebble web user add`"),
    ],
)
def test_what_is_missing_is_said(web: dict[str, Any], more: dict[str, Any], words: str) -> None:
    assert re.search(words, problem(web, **more), re.DOTALL)


def test_users_that_cannot_be_read_hide_no_other_problem(tmp_path: Path) -> None:
    raw = {"robot": {"id": "goob"}, "web_interface": {"host": "0.0.0.0", "people": str(tmp_path)}, **REMOTE}
    with pytest.raises(ConfigError) as caught:
        settings_or_all_problems(parse(raw, folder=tmp_path, env={}))
    first, second = caught.value.problems
    assert first.startswith("web_interface.host: other machines reach 0.0.0.0")
    assert second.startswith(f"{tmp_path}: ")


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


def test_a_config_of_the_original_is_refused_with_what_to_do() -> None:
    with pytest.raises(ConfigError, match=r"web_interface\.host: other machines reach 0\.0\.0\.0"):
        settings_of(load(ROOT / "tests" / "data" / "original-shaped-config.json", env={}))
