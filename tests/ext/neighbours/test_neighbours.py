"""What is refused in `services.neighbours`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from pebble.config import parse
from pebble.config.raw import deep_merge
from pebble.errors import ConfigError
from pebble.services.neighbours.config import MOST_METRICS, MOST_NEIGHBOURS

LAN = {"connect": ["tls/hub.lab:7447"]}
WRONG: list[tuple[dict[str, Any], str]] = [
    ({"lan": {}}, r"lan\.connect: is missing"),
    ({"lan": LAN | {"account": "goob-lan"}}, r"lan\.account: needs tls\.client_cert"),
    ({"shares": ["front-camera"]}, "front-camera cannot be shared"),
    ({"listens": {"fred": ["control/wheels"]}}, "control/wheels cannot be shared"),
    ({"commanded": {"goob": ["estop-reset"]}}, r'must be \["drive-values"\]'),
    ({"listens": {f"r{n}": [] for n in range(MOST_NEIGHBOURS + 1)}}, "are the most"),
    ({"shares": [f"m{n}" for n in range(MOST_METRICS + 1)]}, "are the most"),
]


def read(section: dict[str, Any], **more: Any) -> Any:
    raw = {"robot": {"id": "goob"}, "services": {"neighbours": {"enabled": True, "lan": LAN, **section}}, **more}
    return parse(raw, folder=Path("/"), env={}).services.neighbours


@pytest.mark.parametrize(("section", "why"), WRONG)
def test_what_is_refused(section: dict[str, Any], why: str) -> None:
    with pytest.raises(ConfigError, match=why):
        read(section)


def test_above_open_a_hub_elsewhere_needs_encryption_and_an_account() -> None:
    with pytest.raises(ConfigError) as refused:
        read({"lan": {"connect": ["tcp/hub.lab:7447"]}}, security={"level": "login"})
    assert [text in str(refused.value) for text in ("is not encrypted", "lan.account: is missing")] == [True, True]


LISTENS = {"transport": {"kind": "zenoh", "listen": ["tcp/0.0.0.0:7447"]}}
BRIDGE = {"services": {"mqtt_bridge": {"enabled": True, "remote": {"kind": "zenoh", "connect": ["tls/hub.lab:7447"]}}}}


@pytest.mark.parametrize(
    ("more", "connect", "why"),
    [
        (BRIDGE, "tls/hub.lab:7447#x=1", "is also services.mqtt_bridge.remote.connect"),
        (LISTENS, "tcp/127.0.0.1:7447", "is also transport.listen"),
    ],
)
def test_the_hub_of_the_lan_is_no_other_one(more: dict[str, Any], connect: str, why: str) -> None:
    raw = deep_merge({"services": {"neighbours": {"enabled": True, "lan": {"connect": [connect]}}}}, more)
    with pytest.raises(ConfigError, match=why):
        parse({"robot": {"id": "goob"}, **raw}, folder=Path("/"), env={})
