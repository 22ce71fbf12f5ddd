"""Readers of payloads, which may hold anything: they return JSON objects, numbers and short texts, or nothing."""

import binascii
import json
import os

LONGEST = 512  # bytes of a command; a longer one is not read
INFINITY = float("inf")
HEX = "0123456789abcdef"
NAME = "abcdefghijklmnopqrstuvwxyz0123456789_/-"  # of a person or a device
PRINTABLE = "".join([chr(code) for code in range(32, 127) if chr(code) not in '"\\'])


def command_of(payload):
    """Return the JSON object in a payload; None if there is none."""
    if len(payload) > LONGEST:
        return None
    try:
        value = json.loads(payload)
    except (ValueError, RuntimeError, MemoryError):  # no JSON, no UTF-8, or too deep
        return None
    if not isinstance(value, dict):
        return None
    inner = value.get("value")
    return inner if isinstance(inner, dict) else value  # {"value": {...}} means the same as {...}


def is_number(value):
    """True if the value is a finite number. NaN is none: it is neither smaller nor larger than any other."""
    return type(value) in (int, float) and -INFINITY < value < INFINITY


def clamp(value, least, most):
    return max(least, min(most, value))


def is_hex(text, size):
    """True if the text has ``size`` hexadecimal digits, and nothing else."""
    return isinstance(text, str) and len(text) == size and all(letter in HEX for letter in text.lower())


def new_hex(size):
    """Return ``size`` random hexadecimal digits."""
    return binascii.hexlify(os.urandom(size // 2)).decode()


def only(text, allowed, size):
    """Return a stranger's text in the form to publish: cut, and with _ for each letter that is not allowed."""
    if not isinstance(text, str):
        return ""
    return "".join([letter if letter in allowed else "_" for letter in text[:size]])
