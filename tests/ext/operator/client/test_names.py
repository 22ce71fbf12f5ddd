"""Short names of topics."""

from __future__ import annotations

import pytest

from pebble.errors import PebbleError
from pebble.extensions.operator.client.names import Names, base_of

GOOB = "pebble/robots/goob"


@pytest.mark.parametrize(
    ("name", "filters"),
    [
        ("drive-values", [f"{GOOB}/incoming/drive-values"]),
        ("online", [f"{GOOB}/outgoing/online", f"{GOOB}/outgoing/heartbeat"]),
        ("audio", [f"{GOOB}/outgoing/audio"]),
        ("incoming/audio", [f"{GOOB}/incoming/audio"]),
        ("outlets/o1/power", [f"{GOOB}/incoming/outlets/o1/power"]),
        ("flags/reboot", [f"{GOOB}/incoming/flags/reboot"]),
        ("pebble/robots/fred/outgoing/online", ["pebble/robots/fred/outgoing/online"]),
        ("#", ["#"]),
        ("house/lamp", ["house/lamp"]),
    ],
)
def test_names_to_listen_to(name: str, filters: list[str]) -> None:
    assert Names(GOOB).filters(name) == filters


@pytest.mark.parametrize("typed", ["bär", "ba\u0308r", "pebble/robots/ba\u0308r"])
def test_an_id_is_typed_in_one_form(typed: str) -> None:
    assert base_of(typed) == "pebble/robots/b\u00e4r"


def test_names_to_publish_to() -> None:
    names = Names(base_of("goob"))
    assert names.topic("audio") == f"{GOOB}/incoming/audio"
    assert names.topic("outgoing/audio") == f"{GOOB}/outgoing/audio"
    assert Names().filters("drive-values") == ["+/+/+/incoming/drive-values"]
    with pytest.raises(PebbleError, match="--robot"):
        Names().topic("drive-values")


@pytest.mark.parametrize("name", ["drive-valus", "flags/mqtt-vdeo", "incoming/drive-valus"])
def test_a_misspelt_name_gets_a_suggestion(name: str) -> None:
    with pytest.raises(PebbleError, match="did you mean"):
        Names(GOOB).filters(name)
