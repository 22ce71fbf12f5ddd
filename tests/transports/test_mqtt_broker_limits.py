"""What an MQTT client makes of a broker without retained messages, QoS 1 or wills."""

from __future__ import annotations

from itertools import product
from pathlib import Path

import pytest

from pebble.transports import Message, MqttSettings, QoS, State
from pebble.transports.mqtt.bridge_mode import Result
from pebble.transports.mqtt.broker_limits import EVERYTHING, BrokerLimits, Limits
from pebble.transports.mqtt.transport import MqttTransport
from tests.support import Broker, some, until
from tests.transports.received import Received

NONE = Limits(retain=False, qos=0)
NO_RETAIN, NO_QOS, NO_WILL = Limits(retain=False), Limits(qos=0), Limits(will=False)
RESULTS = {"accepts": Result.ACCEPTED, "hangs up": Result.HUNG_UP, "no retain": Result.RETAIN_REFUSED}
RESULTS |= {"no QoS": Result.QOS_REFUSED, "refuses": Result.FAILED}


@pytest.mark.parametrize(
    ("events", "limits"),
    [
        (["hangs up"] * 20, EVERYTHING),  # a proxy whose broker is away: no probe is accepted
        (["hangs up", "probed"], EVERYTHING),
        (["hangs up", "probed", "accepts"] * 5, EVERYTHING),
        (["hangs up", "probed", "hangs up"], NO_QOS),
        (["hangs up", "probed", *["hangs up"] * 2], NO_RETAIN),
        (["hangs up", "probed", *["hangs up"] * 3], NONE),
        (["hangs up", "probed", *["hangs up"] * 4], NO_WILL),
        (["hangs up", "probed", *["hangs up"] * 5], EVERYTHING),  # the will was not the reason
        (["hangs up", "probed", *["hangs up"] * 2, "refuses"], EVERYTHING),  # the broker has gone
        (["hangs up", "probed", "hangs up", "accepts", *["hangs up"] * 9], NO_QOS),  # it is away
        (["no retain"], NO_RETAIN),
        (["no QoS", "no retain", "accepts"], NONE),
        (["no retain", "accepts", "later"], EVERYTHING),  # it may have another config
        (["refuses"] * 20, EVERYTHING),
    ],
)
def test_what_is_tried_next(events: list[str], limits: Limits) -> None:
    learning, now = BrokerLimits(), 0.0
    for event in events:
        learning.begin(now)
        if event in RESULTS:
            if learning.wants_probe:
                learning.note_probe(Result.FAILED)
            learning.note_connect(RESULTS[event], now)
        elif event == "probed":
            assert learning.wants_probe
            learning.note_probe(Result.ACCEPTED)
        else:
            now += 1000.0
    learning.begin(now)
    assert learning.limits == limits


LACKING = [
    (["retain_available false"], "keeps no retained messages"),
    (["max_qos 0"], "has no QoS 1"),
    (["retain_available false", "max_qos 0"], "keeps no retained messages"),
    ([], ""),
]


CLIENTS = [("3.1.1", True), ("5", True), ("5", False)]  # without a will 3.1.1 tells nothing


@pytest.mark.parametrize(
    ("lacking", "client", "as_published"),
    some(product(LACKING, CLIENTS, (True, False)), 5),
)
def test_messages_pass_both_ways_and_one_warning_names_what_is_lost(
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
    lacking: tuple[list[str], str],
    client: tuple[str, bool],
    as_published: bool,
) -> None:
    (options, lost), (protocol, has_will) = lacking, client
    broker = Broker(tmp_path, *options)
    settings = MqttSettings(host="127.0.0.1", port=broker.port, protocol=protocol, as_published=as_published)
    will = Message("robot/online", b"gone", QoS.DELIVERED, retain=True)
    robot = MqttTransport("robot", settings, will=will if has_will else None)
    operator = MqttTransport("operator", MqttSettings(host="127.0.0.1", port=broker.port)).open()
    try:
        seen, commands = Received(), Received()
        operator.subscribe("robot/#", seen)
        robot.open().subscribe("commands/#", commands, echo=False)
        robot.publish("robot/state", b"state", qos=QoS.DELIVERED, retain=True)
        assert until(lambda: b"state" in seen.payloads)
        assert until(lambda: robot.publish("robot/event", b"event", qos=QoS.DELIVERED) and b"event" in seen.payloads)
        assert until(lambda: operator.publish("commands/stop", b"", urgent=True) and commands.payloads)
        assert until(lambda: not lost or any(lost in record.getMessage() for record in caplog.records))
        warned = [record.levelno for record in caplog.records if "that is changed" in record.getMessage()]
        assert len(warned) == ("retain" in lost)
        broker.stop()
        assert until(lambda: robot.state is not State.CONNECTED)
        broker.start()
        assert until(lambda: robot.state is State.CONNECTED)
        robot.close()
        assert until(lambda: not has_will or b"gone" in seen.payloads)
    finally:
        robot.close()
        operator.close()
        broker.stop()
