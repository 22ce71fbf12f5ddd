"""Whom a broker lets in: the account of the config, others without a name, and whether what they send can be read."""

import time
from collections.abc import Callable, Iterator

from pebble.check_result import CheckResult
from pebble.config.secret_text import shown_user
from pebble.config.security import SecurityLevel
from pebble.config.web import is_loopback
from pebble.doctor import fail, ok, warn
from pebble.doctor.broker_probe import REFUSED_ID, REFUSED_LOGINS, ProbeResult, probe
from pebble.transports.settings import MqttSettings

SOON_S = 14 * 86400


def broker(
    name: str,
    settings: MqttSettings,
    probe_login: Callable[..., ProbeResult] = probe,
    now: float | None = None,
    level: SecurityLevel = "open",
) -> Iterator[CheckResult]:
    """Check that it answers, accepts the config's login, refuses anonymous ones, and is encrypted.

    Above the level ``open`` one that lets everybody in is no mere warning.
    """
    what = f"{name} {settings.host}:{settings.port}"
    own = probe_login(settings, login=True)
    if own.code is None:
        start = (
            "sudo systemctl start mosquitto"
            if is_loopback(settings.host)
            else f"nc -vz {settings.host} {settings.port}"
        )
        yield fail(what, f"cannot be reached: {own.problem}", start)
        return
    yield _login(what, settings, own)
    if own.problem and not is_loopback(settings.host):
        yield warn(
            what,
            f"has addresses that do not answer: {own.problem}",
            f"correct the addresses of {settings.host} in your DNS, or start the brokers there",
        )
    without_login = own if settings.username is None else probe_login(settings, login=False)
    yield _anonymous_logins(what, settings, without_login, level)
    yield _encryption(what, settings, own, time.time() if now is None else now)


def _login(what: str, settings: MqttSettings, answer: ProbeResult) -> CheckResult:
    if answer.code == 0:
        return ok(what, f"answers, connected in {answer.connect_ms:.1f} ms")
    if answer.code == REFUSED_ID:
        fix = "let it admit any client id, or set remote_mqtt.client_id to one that it knows"
        return fail(what, "refuses the client id", fix)
    why = REFUSED_LOGINS.get(answer.code or 0, f"code {answer.code}")
    if settings.username is None:
        return fail(what, f"refuses the login: {why}", "set username and password_file of this broker")
    return fail(
        what,
        f"refuses user {(user := shown_user(settings.username))}: {why}",
        f"on the broker: sudo mosquitto_passwd /etc/mosquitto/passwd {user}",
    )


def _anonymous_logins(what: str, settings: MqttSettings, answer: ProbeResult, level: SecurityLevel) -> CheckResult:
    if answer.code != 0:
        return ok(what, "refuses anonymous logins")
    if is_loopback(settings.host):
        return ok(what, "accepts anonymous logins: every program on this machine can drive the robot")
    return (warn if level == "open" else fail)(
        what,
        "accepts anonymous logins: every client that reaches it can drive the robot",
        "in mosquitto.conf: allow_anonymous false, password_file /etc/mosquitto/passwd",
    )


def _encryption(what: str, settings: MqttSettings, answer: ProbeResult, now: float) -> CheckResult:
    if settings.tls is None:
        if is_loopback(settings.host):
            return ok(what, "not encrypted, which is fine on this machine")
        return warn(
            what, "is not encrypted: commands and passwords can be read on the network", "set tls.enabled to true"
        )
    if answer.expires is not None and answer.expires - now < SOON_S:
        days = (answer.expires - now) / 86400
        return warn(what, f"its certificate expires in {days:.0f} days", "renew the broker's certificate")
    if settings.tls.insecure:
        return warn(what, "encrypted, but the name in its certificate is not checked", "set tls.insecure to false")
    left = "" if answer.expires is None else f", its certificate for {(answer.expires - now) / 86400:.0f} more days"
    return ok(what, f"encrypted{left}")
