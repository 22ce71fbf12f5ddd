"""Gives names the addresses in ``TEST_HOSTS``: Python imports this at its start if the folder is in ``PYTHONPATH``."""

import os
import socket
from typing import Any

_NAMES = {
    name: addresses.split(",")
    for name, _, addresses in (one.partition("=") for one in os.environ.get("TEST_HOSTS", "").split())
}
_real = socket.getaddrinfo


def _getaddrinfo(host: Any, *arguments: Any, **options: Any) -> list[Any]:
    return [info for one in _NAMES.get(os.fsdecode(host or ""), [host]) for info in _real(one, *arguments, **options)]


socket.getaddrinfo = _getaddrinfo
