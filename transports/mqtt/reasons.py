"""The reason codes of MQTT in words (MQTT 3.1.1, 3.2.2.3; MQTT 5.0, 2.4)."""

from typing import Final

FAILURE: Final = 0x80  # MQTT 5: this code and those above are errors
TAKEN_OVER: Final = 0x8E
NO_RETAIN: Final = 0x9A
NO_QOS: Final = 0x9B
PROTOCOL_REFUSED: Final = 1  # of 3.1.1: what some brokers answer to bridge mode

#: MQTT 5: why a broker closes a connection whatever was published on it.
_OF_NO_MESSAGE = frozenset({0x00, 0x88, 0x89, 0x8A, 0x8B, 0x8D, TAKEN_OVER, 0x96, 0x98, 0x9C, 0x9D, 0x9F, 0xA0})

_OF_3_1_1 = {1: 0x84, 2: 0x85, 3: 0x88, 4: 0x86, 5: 0x87}  # CONNACK's codes as those of MQTT 5

_OF_LOGIN = frozenset({0x86, 0x87, 0x8C})

_WORDS = {
    0x80: "unspecified error",
    0x81: "malformed packet",
    0x82: "protocol error",
    0x83: "implementation specific error",
    0x84: "unsupported protocol version",
    0x85: "client identifier not valid",
    0x86: "bad user name or password",
    0x87: "not authorized",
    0x88: "server unavailable",
    0x89: "server busy",
    0x8A: "banned",
    0x8B: "server shutting down",
    0x8C: "bad authentication method",
    0x8D: "keep alive timeout",
    TAKEN_OVER: "session taken over",
    0x8F: "topic filter invalid",
    0x90: "topic name invalid",
    0x91: "packet identifier in use",
    0x92: "packet identifier not found",
    0x93: "receive maximum exceeded",
    0x94: "topic alias invalid",
    0x95: "packet too large",
    0x96: "message rate too high",
    0x97: "quota exceeded",
    0x98: "administrative action",
    0x99: "payload format invalid",
    NO_RETAIN: "retain not supported",
    NO_QOS: "QoS not supported",
    0x9C: "use another server",
    0x9D: "server moved",
    0x9E: "shared subscription not supported",
    0x9F: "connection rate exceeded",
    0xA0: "maximum connect time",
    0xA1: "subscription identifiers not supported",
    0xA2: "wildcard subscription not supported",
}


def words(code: int) -> str:
    """Return the name of a reason code of MQTT 5, or of a SUBACK of 3.1.1."""
    return _WORDS.get(code, "normal disconnection" if code == 0 else f"code {code}")


def may_concern_message(code: int) -> bool:
    """True if a DISCONNECT with this code may be the answer to a message."""
    return code not in _OF_NO_MESSAGE


def concerns_login(code: int) -> bool:
    """True if an answer (a CONNACK of either version, or another) refuses the login, not the request."""
    return _OF_3_1_1.get(code, code) in _OF_LOGIN


def connection_refused(code: int) -> str:
    """Return the reason in words of a CONNACK, of either version, that refuses us."""
    code = _OF_3_1_1.get(code, code)
    if code == 0x87:  # mosquitto's answer to a wrong password on 3.1.1
        return "not authorized (bad user name or password?)"
    return words(code)
