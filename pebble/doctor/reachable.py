"""Checks whether a broker that is meant for this machine alone also answers at its addresses on the network."""

import ipaddress
import re
import socket
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path

from pebble.check_result import CheckResult
from pebble.doctor import ok, warn
from pebble.doctor.broker_probe import probe
from pebble.transports.settings import MqttSettings

_TIMEOUT_S = 1.0  # these addresses are this machine's own
_LOCAL_IPV4 = re.compile(r"\|-- (\S+)\n\s+/32 host LOCAL")


def beyond_loopback(name: str, settings: MqttSettings, addresses: Iterable[str]) -> Iterator[CheckResult]:
    """Try the port of a loopback broker at each of ``addresses``; nothing if there are none."""
    tls = None if settings.tls is None else replace(settings.tls, insecure=True)  # its certificate names the loopback
    found = {
        address: probe(replace(settings, host=address, tls=tls), login=False, timeout_s=_TIMEOUT_S).code
        for address in addresses
    }
    what = f"{name} {settings.host}:{settings.port}"
    if not found:
        return
    answers = [address for address, code in found.items() if code is not None]
    if open_ := [address for address, code in found.items() if code == 0]:
        yield warn(
            what,
            f"also answers at {', '.join(open_)} and accepts anonymous logins: the network can drive the robot",
            f"in mosquitto.conf: listener {settings.port} 127.0.0.1, or allow_anonymous false and a password_file",
        )
    elif answers:
        yield ok(what, f"also answers at {', '.join(answers)}, and refuses anonymous logins there")
    else:
        yield ok(what, f"does not answer at {', '.join(found)}")


def own_addresses(proc: Path = Path("/proc")) -> list[str]:
    """The addresses of this machine that are not its loopback's, IPv4 first; of Linux only."""
    ipv4 = _LOCAL_IPV4.findall(_text(proc / "net/fib_trie"))
    ipv6 = [_ipv6(line.split()) for line in _text(proc / "net/if_inet6").splitlines()]
    return [one for one in dict.fromkeys(ipv4 + ipv6) if not ipaddress.ip_address(one.partition("%")[0]).is_loopback]


def _ipv6(words: list[str]) -> str:
    """The address in a line such as ``fe80…0001 04 40 20 80 eth0``; a link-local address needs the name of its link."""
    address = socket.inet_ntop(socket.AF_INET6, bytes.fromhex(words[0]))
    return f"{address}%{words[5]}" if ipaddress.ip_address(address).is_link_local else address


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except OSError:  # no IPv6, or a kernel without this file
        return ""
