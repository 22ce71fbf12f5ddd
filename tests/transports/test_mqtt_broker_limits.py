"""What an MQTT client makes of a broker without retained messages, QoS 1, wills or bridge mode."""

from __future__ import annotations

from pathlib import Path

import pytest

from pebble.transports import Message, MqttSettings, QoS, State
from pebble.transports.mqtt.bridge_mode import BridgeMode, Result
from pebble.transports.mqtt.broker_limits import EVERYTHING, BrokerLimits, Limits
from pebble.transports.mqtt.transport import MqttTransport
from tests.support import Broker, until
from tests.transports.received import Received

NONE = Limits(retain=False, qos=0)
NO_RETAIN, NO_QOS, NO_WILL = Limits(retain=False), Limits(qos=0), Limits(will=False)
RESULTS = {"accepts": Result.ACCEPTED, "hangs up": Result.HUNG_UP, "no retain": Result.RETAIN_REFUSED}
RESULTS |= {"no QoS": Result.QOS_REFUSED, "refuses": Result.FAILED}


@pytest.mark.parametrize(
    ("events", "limits"),
    [
        (["hangs up"] * 20, EVERYTHING),  # a proxy whose broker is away: no probe is accepted
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


@pytest.mark.parametrize(
    ("lacking", "protocol", "lost"),
    [("retain_available false", "3.1.1", "keeps no retained messages"), ("max_qos 0", "5", "has no QoS 1")],
)
def test_messages_pass_both_ways_and_one_warning_names_what_is_lost(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, lacking: str, protocol: str, lost: str
) -> None:
    broker = Broker(tmp_path, lacking)
    settings = MqttSettings(host="127.0.0.1", port=broker.port, protocol=protocol, as_published=True)
    will = Message("robot/online", b"gone", QoS.DELIVERED, retain=True)
    robot = MqttTransport("robot", settings, will=will)
    operator = MqttTransport("operator", MqttSettings(host="127.0.0.1", port=broker.port)).open()
    try:
        seen, commands = Received(), Received()
        operator.subscribe("robot/#", seen)
        robot.open().subscribe("commands/#", commands, echo=False)
        robot.publish("robot/state", b"state", qos=QoS.DELIVERED, retain=True)
        assert until(lambda: b"state" in seen.payloads)
        assert until(lambda: robot.publish("robot/event", b"event", qos=QoS.DELIVERED) and b"event" in seen.payloads)
        assert until(lambda: operator.publish("commands/stop", b"", urgent=True) and commands.payloads)
        assert until(lambda: any(lost in line for line in caplog.messages))
        warned = [line for line in caplog.messages if "that is changed" in line]
        assert len(warned) == ("retain" in lost)
        broker.stop()
        assert until(lambda: robot.state is not State.CONNECTED)
        broker.start()
        assert until(lambda: robot.state is State.CONNECTED)
        robot.close()
        assert until(lambda: b"gone" in seen.payloads)
    finally:
        robot.close()
        operator.close()
        broker.stop()


ACCEPTED, PROTOCOL, HUNG_UP, OTHER = Result.ACCEPTED, Result.PROTOCOL_REFUSED, Result.HUNG_UP, Result.FAILED


@pytest.mark.parametrize(
    ("results", "attempts"),
    [
        ([PROTOCOL, OTHER], "bridge plain bridge"),
        ([OTHER] * 4, "bridge bridge bridge bridge bridge"),  # a wrong password, say
        ([HUNG_UP] * 6, "bridge probe bridge probe bridge probe bridge"),  # a proxy whose broker is away
        ([HUNG_UP, ACCEPTED, ACCEPTED], "bridge probe bridge bridge"),  # the broker was just starting
        ([HUNG_UP, ACCEPTED, OTHER, HUNG_UP], "bridge probe bridge bridge probe"),
        ([HUNG_UP, ACCEPTED, HUNG_UP, ACCEPTED, HUNG_UP], "bridge probe bridge plain bridge plain"),  # remembered
        ([PROTOCOL, ACCEPTED, HUNG_UP], "bridge plain bridge plain"),  # it is tried again with each connection
        ([PROTOCOL, ACCEPTED, ACCEPTED, HUNG_UP], "bridge plain bridge bridge probe"),  # another broker
    ],
)
def test_attempts_with_bridge_mode(results: list[Result], attempts: str) -> None:
    """Those that end with ``results``, and the one after them."""
    mode = BridgeMode()
    made = []
    for result in results:
        made.append(mode.next_attempt.value)
        mode.note(result)
    assert [*made, mode.next_attempt.value] == attempts.split()
