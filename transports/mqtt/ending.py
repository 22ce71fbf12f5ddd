"""Reasons why a connection to an MQTT broker could not be made, or has ended."""

import ssl
from typing import Final

from pebble.transports.mqtt.bridge_mode import Result

#: What to do if a broker hangs up on a CONNECT without TLS, and if it hangs up on TLS.
WANTS_TLS: Final = "if this port is for TLS: mqtts://, or tls.enabled in a config"
_NO_TLS: Final = "if this port is not for TLS: mqtt://, or the port for TLS (8883)"
_OTHER_NAME: Final = "name the host as it does"
_EARLY: Final = "set the clock of this machine"
_EXPIRED: Final = "renew it"
_UNKNOWN: Final = "name its authority: --ca-cert FILE, tls.ca_cert"
_OUR_CERTIFICATE: Final = "give this machine one that it accepts: tls.client_cert, tls.client_key"
#: How to mend a certificate that is refused, by OpenSSL's number of the reason; by default its authority is not known.
_CERTIFICATE: Final = {9: _EARLY, 10: _EXPIRED, 62: _OTHER_NAME, 64: _OTHER_NAME}
TLS_FIXES: Final = (WANTS_TLS, _NO_TLS, _OTHER_NAME, _EARLY, _EXPIRED, _UNKNOWN, _OUR_CERTIFICATE)


class Lost(Exception):  # noqa: N818  (an event, not a mistake)
    """An error: a connection could not be made, or is lost. Its text explains why."""


class Silent(Lost):
    """An error: the other side does not answer."""


class Absent(Lost):
    """An error: nothing listens at the address."""


class TlsLate(Lost):
    """An error: TLS takes too long, although TCP was connected in time."""


class Refused(Lost):
    """An error: the broker refused our CONNECT, or closed the connection instead of answering."""

    def __init__(self, text: str, result: Result = Result.FAILED) -> None:
        super().__init__(text)
        self.result = result


def alert(error: Exception | None) -> str:
    """Return in words with which alert of TLS the other side has ended the connection; empty if ``error`` is none."""
    reason = (isinstance(error, ssl.SSLError) and error.reason) or ""  # for example TLSV1_ALERT_UNKNOWN_CA
    return reason.partition("ALERT_")[2].replace("_", " ").lower()


def unreached(error: Exception, *, tls: bool) -> str:
    """Return in words why a broker cannot be reached, with what to do if that is known."""
    if isinstance(error, ConnectionRefusedError):
        return "nothing listens there, is it up?"
    if isinstance(error, ssl.SSLCertVerificationError):
        fix = _CERTIFICATE.get(error.verify_code, _UNKNOWN)
        return f"its certificate is refused: {error.verify_message.rstrip('.')}; {fix}"
    if why := alert(error):
        is_ours = "certificate" in why or why == "unknown ca"
        return f"it refuses our certificate: {why}; {_OUR_CERTIFICATE}" if is_ours else f"it refuses our TLS: {why}"
    if tls and (isinstance(error, ConnectionError | ssl.SSLEOFError) or "WRONG_VERSION" in str(error)):
        return f"it answers no TLS; {_NO_TLS}"
    return getattr(error, "strerror", None) or str(error)
