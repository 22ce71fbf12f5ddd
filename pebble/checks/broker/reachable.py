"""Checks whether a broker that is meant for its machine alone also answers on the network."""

from collections.abc import Iterable, Iterator
from dataclasses import replace

from pebble.checks.broker import MOSQUITTO
from pebble.checks.broker.login_attempt import attempt
from pebble.checks.check import CheckResult, ok, warn
from pebble.checks.machine import printed
from pebble.transports.settings import MqttSettings

_TIMEOUT_S = 1.0  # these addresses are this machine's own


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


def own_addresses() -> list[str]:
    """Return the addresses of this machine on its networks; none on systems whose ``hostname`` does not tell them."""
    return printed("hostname", "-I").split()
