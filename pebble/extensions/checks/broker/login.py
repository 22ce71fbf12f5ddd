"""Checks of a broker's logins, of its addresses, and of whether its connections are encrypted."""

import time
from collections.abc import Iterable, Iterator
from dataclasses import replace

from pebble.check_result import CheckResult, failed, ok, warn
from pebble.config.hosts import is_loopback
from pebble.config.secret_text import shown_user
from pebble.config.security import SecurityLevel
from pebble.extensions.checks.broker import MOSQUITTO
from pebble.extensions.checks.broker.login_attempt import TIMEOUT_S, LoginAttempt, attempt
from pebble.extensions.checks.check import SOON_DAYS
from pebble.extensions.checks.machine import printed
from pebble.extensions.operator.places import mosquitto_path
from pebble.transports.mqtt import reasons
from pebble.transports.mqtt.ending import TLS_FIXES
from pebble.transports.settings import MqttSettings

#: How to mend what a broker refuses, by its reason; for any other its log says why.
_FIXES = {
    reasons.words(0x84): 'set protocol of this broker to "3.1.1" or "5", as it speaks',
    reasons.words(0x85): "let it admit any client id, or set remote_mqtt.client_id to one that it knows",
}
_UNKNOWN = "does not tell whether it lets in who has no login"
_HERE_S = 1.0  # within which an address of this machine answers


def broker(
    name: str, settings: MqttSettings, level: SecurityLevel = "open", answer_s: float = TIMEOUT_S
) -> Iterator[CheckResult]:
    """Check that the broker answers, accepts the config's login, refuses anonymous clients, and encrypts.

    Above the level ``open``, a broker that accepts everybody is a failure instead of a warning.
    """
    what, is_here = f"{name} {settings.host}:{settings.port}", is_loopback(settings.host)
    answer = attempt(settings, login=True, timeout_s=answer_s)
    if answer.code is None:
        start = "sudo systemctl start mosquitto"
        if not is_here:
            start = f"on {settings.host}: {start}; or correct the address {settings.host}:{settings.port}"
        elif mosquitto_path() is None:
            start = "sudo apt install mosquitto"
        fix = next((fix for fix in TLS_FIXES if fix in answer.problem), start)
        yield failed(f"cannot be reached: {answer.problem.replace(f'; {fix}', '')}", fix, what)
        return
    yield replace(_own_login(settings, answer, level), what=what)
    if answer.problem and not is_here:
        fix = f"correct the addresses of {settings.host} in your DNS, or start the brokers there"
        yield warn(f"has addresses that do not answer: {answer.problem}", fix, what)
    without_name = answer if settings.username is None else attempt(settings, login=False, timeout_s=answer_s)
    yield replace(_anonymous_login(without_name, level, is_here=is_here), what=what)
    yield replace(_encryption(settings, answer, is_here=is_here), what=what)


def _own_login(settings: MqttSettings, answer: LoginAttempt, level: SecurityLevel) -> CheckResult:
    if answer.code == 0:
        return ok(f"answers, and lets it in within {answer.took_ms:.1f} ms")
    why = answer.refusal
    if not answer.refuses_login:
        return failed(f"refuses the connection: {why}", _FIXES.get(why, "its log says why"))
    if settings.username is None:
        return failed(f"refuses the login: {why}", "set username and password_file of this broker")
    user = shown_user(settings.username)
    fix = f"put the password of {user} into its password_file; a new one: pebble fleet password {user}"
    if level == "open":  # perhaps no fleet
        fix += f", or on the broker: sudo mosquitto_passwd /etc/mosquitto/passwd {user}"
    return failed(f"refuses user {user}: {why}", fix)


def _anonymous_login(answer: LoginAttempt, level: SecurityLevel, *, is_here: bool) -> CheckResult:
    if answer.refuses_login:
        return ok("refuses anonymous logins")
    if answer.code != 0:
        return warn(f"{_UNKNOWN}: {answer.refusal}")
    if is_here:
        return ok("accepts anonymous logins: every program on this machine can drive the robot")
    text = "accepts anonymous logins: every client that reaches it can drive the robot"
    fix = f"{MOSQUITTO}allow_anonymous false, password_file /etc/mosquitto/passwd"
    return warn(text, fix) if level == "open" else failed(text, fix)


def _encryption(settings: MqttSettings, answer: LoginAttempt, *, is_here: bool) -> CheckResult:
    if settings.tls is None:
        if is_here:
            return ok("not encrypted, which is fine on this machine")
        return warn("is not encrypted: commands and passwords can be read on the network", "set tls.enabled to true")
    days = None if answer.expires is None else (answer.expires - time.time()) / 86400
    if days is not None and days < SOON_DAYS:
        return warn(f"its certificate expires in {days:.0f} days", "renew the broker's certificate")
    if settings.tls.insecure:
        return warn("encrypted, but the name in its certificate is not checked", "set tls.insecure to false")
    return ok("encrypted" if days is None else f"encrypted, its certificate for {days:.0f} more days")


def beyond_loopback(name: str, settings: MqttSettings, addresses: Iterable[str]) -> Iterator[CheckResult]:
    """Try the port of a broker that should be reachable from its own machine only, at each of ``addresses``."""
    tls = None if settings.tls is None else replace(settings.tls, insecure=True)  # its certificate names the loopback
    answers = {
        address: attempt(replace(settings, host=address, tls=tls), login=False, timeout_s=_HERE_S)
        for address in addresses
    }
    what = f"{name} {settings.host}:{settings.port}"
    answering = {address: answer for address, answer in answers.items() if answer.code is not None}
    anonymous = [address for address, answer in answering.items() if answer.code == 0]
    unclear = [answer.refusal for answer in answering.values() if not answer.refuses_login]
    if anonymous:
        yield warn(
            f"also answers at {', '.join(anonymous)} and accepts anonymous logins: the network can drive the robot",
            f"{MOSQUITTO}listener {settings.port} 127.0.0.1, or allow_anonymous false and a password_file",
            what,
        )
    elif unclear:
        yield warn(f"also answers at {', '.join(answering)}, but {_UNKNOWN}: {unclear[0]}", what=what)
    elif answering:
        yield ok(f"also answers at {', '.join(answering)}, and refuses anonymous logins there", what=what)
    elif answers:
        yield ok(f"serves this machine only: nothing answers at {', '.join(answers)}", what=what)


def own_addresses() -> list[str]:
    """Return this machine's network addresses; empty on systems whose ``hostname`` cannot print them."""
    return printed("hostname", "-I").split()
