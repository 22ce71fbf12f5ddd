"""Interfaces that are local_only never leave the robot: the rule alone, and with real bridges."""

from __future__ import annotations

import json
from typing import Any

import pytest

from pebble.services.serial_mcu_bridge.devices.private_topics import LocalOnly
from pebble.transports import Message
from tests.kit.robot import BASE

OUT = f"{BASE}/outgoing"
PRIVATE = ("mcu/spy-1/fast", "lab/fast", "mcu/spy-1/secret", "lab/secret", "mcu/spy-1/imu_fast", "lab/imu-fast")


DESCRIBE, LIST = "mcu/spy-1/describe", "mcu/spy-1/local-only"
LISTED = tuple(f"outgoing/{metric}" for metric in PRIVATE)
COMMANDS = ("incoming/mcu/spy-1/tune", "incoming/lab/tune")


def local_only(*topics: str, uid: str = "spy-1") -> Message:
    payload = json.dumps({"topics": topics}).encode()
    return Message(f"{OUT}/mcu/{uid}/local-only", payload, retain_requested=True)


def sample(interface: str, uid: str = "spy-1") -> bytes:
    body = {"t": 1, "seq": 1, "mcu_ms": 1, "device_uid": uid, "interface": interface, "profile": "", "value": {"v": 1}}
    return json.dumps(body).encode()


def value(metric: str, interface: str = "", **more: Any) -> Message:
    """A value of the interface that the topic ends with, unless another is named."""
    return Message(f"{OUT}/{metric}", sample(interface or metric.rpartition("/")[2]), **more)


def cleared(metric: str) -> Message:
    return Message(f"{OUT}/{metric}", b"", retain_requested=True)


FAST, SLOW = ("mcu/spy-1/fast", "lab/fast"), ("mcu/spy-1/slow", "lab/slow")
SECRET = value("mcu/spy-1/secret", retain_requested=True)
KNOWN = local_only(*LISTED)
NONSENSE = (b"", b"{", b'{"device_uid": 5}', b'["device_uid"]', b"\xff\xfe", sample("slow"))
#: What is offered one after the other, and what passes then: the message, nothing, or the topics that are named.
HISTORIES: dict[str, list[tuple[Message, bool | list[str]]]] = {
    "what is listed stays, and what is not passes": [
        (KNOWN, False),
        *((value(metric), False) for metric in PRIVATE),
        *((value(metric), True) for metric in SLOW),
    ],
    "before the list nothing of the MCU passes but its manifest": [
        *((value(metric), False) for metric in (*FAST, *SLOW)),
        (value("anywhere/else", "fast"), False),
        (Message(f"{OUT}/{DESCRIBE}", b"{}", retain_requested=True), True),
        (KNOWN, False),
        *((value(metric), False) for metric in FAST),
        *((value(metric), True) for metric in SLOW),
    ],
    # Retained messages arrive in any order, and later subscribers need the state of a socket.
    **{
        f"a value with {flag} waits for the list": [
            *((value(metric, **{flag: True}), False) for metric in (*SLOW, "lab/secret")),
            (KNOWN, [*SLOW]),
            (KNOWN, False),
        ]
        for flag in ("retain", "retain_requested")
    },
    "a retained value that was cleared is not forwarded later": [
        *(step for one in SLOW for step in ((value(one, retain=True), False), (cleared(one), True))),
        (KNOWN, False),
    ],
    "a board that restarts: nothing passes until it is described again, and its states are cleared": [
        (KNOWN, False),
        (cleared(LIST), False),
        (cleared("mcu/spy-1/slow"), True),
        (cleared("mcu/spy-1/secret"), False),
        *((value(metric), False) for metric in (*FAST, *SLOW)),
        (KNOWN, False),
        *((value(metric), True) for metric in SLOW),
    ],
    "a manifest that changes makes public what was private": [
        (KNOWN, False),
        (SECRET, False),
        (local_only(), False),
        (SECRET, True),
    ],
    "a manifest that changes makes private what was public": [
        *((local_only(), False), (value("lab/slow"), True)),
        *((local_only("outgoing/lab/slow"), False), (value("lab/slow"), False)),
    ],
    "two boards with one alias: the list of each counts, and neither speaks for the other": [
        (local_only(), False),
        (value("lab/slow", retain=True), True),
        (Message(f"{OUT}/lab/slow", sample("slow", "spy-2"), retain=True), False),
        (local_only("outgoing/lab/slow", uid="spy-2"), False),
        (value("lab/slow"), False),
        (value("mcu/spy-1/slow"), True),
    ],
    "a list that cannot be read lets nothing pass, of this MCU": [
        *((KNOWN, False), (local_only(uid="spy-2"), False)),
        (Message(f"{OUT}/{LIST}", b'{"topics": 5}', retain_requested=True), False),
        *((value("lab/slow"), False), (value("mcu/spy-2/slow"), True)),
    ],
    "a list keeps no stop and no control of the robot back": [
        (local_only("outgoing/estop-state/goob", "outgoing/control/goob"), False),
        *((Message(f"{OUT}/{metric}", b"{}"), True) for metric in ("estop-state/goob", "control/goob")),
    ],
    "nonsense is neither an error nor held back": [
        (KNOWN, False),
        *((Message(f"{OUT}/strange", payload), True) for payload in NONSENSE),
        (value("lab/slow"), True),
    ],
}


@pytest.mark.parametrize("history", HISTORIES.values(), ids=HISTORIES)
def test_what_passes(history: list[tuple[Message, bool | list[str]]]) -> None:
    topics = LocalOnly(BASE)
    for message, passes in history:
        expected = [message.topic.removeprefix(f"{OUT}/")] if passes is True else passes or []
        assert [admitted.topic.removeprefix(f"{OUT}/") for admitted in topics.admit(message)] == expected, message


def test_which_commands_stay() -> None:
    """Requests for a manifest do not leave the robot, nor commands to an MCU without a list."""
    topics = LocalOnly(BASE)
    incoming = [f"{BASE}/incoming/{metric}" for metric in ("mcu/spy-1/describe", "mcu/spy-1/tune", "mcu/spy-1/set")]
    aliases = [f"{BASE}/incoming/{metric}" for metric in ("lab/tune", "lab/set", "estop", "drive-values")]
    assert [topics.stays(topic) for topic in (*incoming, *aliases)] == [True] * 3 + [False] * 4
    topics.admit(local_only(*COMMANDS, "incoming/estop"))
    assert [topics.stays(topic) for topic in (*incoming, *aliases)] == [True, True, False, True, False, False, False]


def test_memory_is_bounded() -> None:
    topics = LocalOnly(BASE)
    for number in range(300):
        assert topics.admit(value(f"lab/slow-{number}", "slow", retain=True)) == []
    assert len(topics.admit(KNOWN)) == 256, "waiting values"
    for number in range(300):
        topics.admit(local_only(uid=f"spy-{number}"))
    slow = [Message(f"{OUT}/mcu/spy-{number}/slow", b"{}") for number in range(300)]
    assert sum(len(topics.admit(message)) for message in slow) == 256, "MCUs"
