"""Checks whether a broker answers where it should not: on the network, or without encryption."""

import ipaddress
import re
import socket
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path

from pebble.checks.broker import MOSQUITTO
from pebble.checks.broker.login_attempt import attempt
from pebble.checks.check import CheckResult, ok, warn
from pebble.config.web import is_loopback
from pebble.transports.settings import MqttSettings

_UNENCRYPTED = 1883
_TIMEOUT_S = 1.0  # these addresses are this machine's own
_LOCAL_IPV4 = re.compile(r"\|-- (\S+)\n\s+/32 host LOCAL")


def other_doors(name: str, settings: MqttSettings) -> Iterator[CheckResult]:
    """Try its port at this machine's addresses, if it is meant for this machine alone; and its port without TLS."""
    if is_loopback(settings.host):
        yield from beyond_loopback(name, settings, own_addresses())
    if settings.tls is None:
        return
    what = f"{name} {settings.host}:{_UNENCRYPTED}"
    plain = replace(settings, port=_UNENCRYPTED, tls=None)
    code = attempt(plain, login=False).code  # without the password: it could be read
    if code is None:
        yield ok("does not answer without encryption", what=what)
        return
    more = ", and accepts clients without a name" if code == 0 else ""
    fix = f"{MOSQUITTO}listener {_UNENCRYPTED} 127.0.0.1, or none there"
    yield warn(f"also answers without encryption{more}", fix, what)


def beyond_loopback(name: str, settings: MqttSettings, addresses: Iterable[str]) -> Iterator[CheckResult]:
    """Try the port of a loopback broker at each of ``addresses``; nothing if there are none."""
    tls = None if settings.tls is None else replace(settings.tls, insecure=True)  # its certificate names the loopback
    codes = {
        address: attempt(replace(settings, host=address, tls=tls), login=False, timeout_s=_TIMEOUT_S).code
        for address in addresses
    }
    what = f"{name} {settings.host}:{settings.port}"
    if not codes:
        return
    answers = [address for address, code in codes.items() if code is not None]
    if is_open := [address for address, code in codes.items() if code == 0]:
        yield warn(
            f"also answers at {', '.join(is_open)} and accepts anonymous logins: the network can drive the robot",
            f"{MOSQUITTO}listener {settings.port} 127.0.0.1, or allow_anonymous false and a password_file",
            what,
        )
    elif answers:
        yield ok(f"also answers at {', '.join(answers)}, and refuses anonymous logins there", what=what)
    else:
        yield ok(f"does not answer at {', '.join(codes)}", what=what)


def own_addresses(proc: Path = Path("/proc")) -> list[str]:
    """Return the addresses of this machine that are not its loopback's, IPv4 first; of Linux only."""
    ipv4 = _LOCAL_IPV4.findall(_text(proc / "net/fib_trie"))
    ipv6 = [_ipv6(line.split()) for line in _text(proc / "net/if_inet6").splitlines()]
    addresses = dict.fromkeys(ipv4 + ipv6)
    return [address for address in addresses if not ipaddress.ip_address(address.partition("%")[0]).is_loopback]


def _ipv6(words: list[str]) -> str:
    """Return the address of a line such as ``fe80…0001 04 40 20 80 eth0``; a link-local one needs the link's name."""
    address = socket.inet_ntop(socket.AF_INET6, bytes.fromhex(words[0]))
    return f"{address}%{words[5]}" if ipaddress.ip_address(address).is_link_local else address


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except OSError:  # no IPv6, or a kernel without this file
        return ""
