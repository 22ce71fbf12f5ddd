"""Addresses of connections."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from pebble.extensions.operator.client.url import UrlError, settings_of
from pebble.runtime.connections import ALL_VITAL
from pebble.transports import MqttSettings, ZenohSettings


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


def test_encrypted_urls_and_run_directories(tmp_path: Path) -> None:
    kind, settings = settings_of("mqtts://ann@broker", password="secret", ca_cert=tmp_path / "ca.pem")
    assert isinstance(settings, MqttSettings)
    assert (kind, settings.port, settings.username, settings.password) == ("mqtt", 8883, "ann", "secret")
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
