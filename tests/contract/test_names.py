"""The sender's account in a topic."""

import pytest

from pebble.contract.names import with_name, without_name

BASE = "pebble/robots/goob"


@pytest.mark.parametrize("metric", ["drive-values", "flags/mqtt-audio", "mcu/lamp/blink", "control/take"])
def test_a_name_stands_behind_incoming(metric: str) -> None:
    topic = with_name(f"{BASE}/incoming/{metric}", "ann")
    assert topic == f"{BASE}/incoming/by/ann/{metric}"
    assert without_name(topic) == ("ann", f"{BASE}/incoming/{metric}")


@pytest.mark.parametrize(
    "topic",
    [
        f"{BASE}/incoming/drive-values",
        f"{BASE}/incoming/by/ann/by/otto/drive-values",
        f"{BASE}/incoming/by/Ann/drive-values",
        f"{BASE}/incoming/by//drive-values",
        f"{BASE}/incoming/by/-/drive-values",
        f"{BASE}/incoming/by/{'a' * 33}/drive-values",
        f"{BASE}/incoming/by/ann",
        f"{BASE}/incoming/by/ann/",
        f"{BASE}/outgoing/by/ann/online",
        "robots/goob/incoming/by/ann/drive-values",
    ],
)
def test_other_topics_have_no_name(topic: str) -> None:
    assert without_name(topic) is None


@pytest.mark.parametrize(
    ("topic", "account"), [(f"{BASE}/outgoing/online", "ann"), (f"{BASE}/incoming/x", "Ann"), ("incoming/x", "ann")]
)
def test_a_name_that_cannot_stand_there_is_refused(topic: str, account: str) -> None:
    with pytest.raises(ValueError, match="takes no name"):
        with_name(topic, account)
