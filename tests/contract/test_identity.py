"""Identity: building topics, taking them apart, refusing levels that no topic can hold."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pebble.contract.identity import Direction, Identity, ParsedTopic, parse_topic
from pebble.errors import ConfigError
from pebble.transports.topics import check_topic

GOOB = Identity("pebble", "robots", "goob")


def test_a_topic_comes_apart_into_what_it_was_built_from() -> None:
    assert GOOB.base == str(GOOB) == "pebble/robots/goob"
    assert GOOB.outgoing("sensors/imu") == "pebble/robots/goob/outgoing/sensors/imu"
    address = parse_topic("pebble/robots/goob/incoming/flags/reboot")
    assert address == ParsedTopic(GOOB, Direction.INCOMING, "flags/reboot")
    assert address.topic == GOOB.incoming("flags/reboot") == "pebble/robots/goob/incoming/flags/reboot"


@pytest.mark.parametrize(
    "topic",
    [
        *("", "pebble/infrastructure", "pebble/robots/goob/incoming", "pebble/robots/goob/incoming/"),
        *("pebble/robots/goob/sideways/online", "pebble/robots//outgoing/online", "$SYS/robots/goob/outgoing/online"),
        "/pebble/robots/goob/outgoing/online",
    ],
)
def test_other_topics_belong_to_no_robot(topic: str) -> None:
    assert parse_topic(topic) is None


@pytest.mark.parametrize("level", ["", "a/b", "a+", "#", "$a", "a$", "a\n", "a\x00", "\ufffe", "x" * 65])
def test_levels_no_topic_can_hold_are_refused(level: str) -> None:
    with pytest.raises(ConfigError, match=r"robot\.id"):
        Identity("pebble", "robots", level)


def test_every_wrong_level_is_reported() -> None:
    with pytest.raises(ConfigError) as caught:
        Identity("", "a/b", "#")
    assert [line.split(":")[0] for line in caught.value.problems] == ["robot.system", "robot.type", "robot.id"]


_levels = st.text(st.characters(codec="utf-8"), min_size=1, max_size=70)


@given(_levels, _levels, _levels)
def test_every_transport_carries_an_accepted_identity(system: str, type_: str, id_: str) -> None:
    try:
        identity = Identity(system, type_, id_)
    except ConfigError:
        return
    topic = check_topic(identity.outgoing("online"))
    assert parse_topic(topic) == ParsedTopic(identity, Direction.OUTGOING, "online")
