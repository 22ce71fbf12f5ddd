"""The versions of TLS that a connection accepts, whatever ciphers a config names."""

from __future__ import annotations

import ssl
from itertools import cycle, islice

import pytest

from pebble.transports.settings import TlsSettings
from pebble.transports.tls import make_context
from tests.support import ROOT

CERTS = ROOT / "tests" / "data" / "tls"
EVERY_CIPHER = "ALL:@SECLEVEL=0"


def agreed(version: ssl.TLSVersion) -> str | None:
    """What a careless config agrees on with a server that speaks only ``version``; in memory."""
    with_server = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    with_server.load_cert_chain(CERTS / "server.crt", CERTS / "server.key")
    with_server.set_ciphers(EVERY_CIPHER)
    with_server.minimum_version = with_server.maximum_version = version
    with_client = make_context(TlsSettings(ca_cert=CERTS / "ca.crt", ciphers=EVERY_CIPHER))
    there, back = ssl.MemoryBIO(), ssl.MemoryBIO()
    client = with_client.wrap_bio(back, there, server_hostname="localhost")
    server = with_server.wrap_bio(there, back, server_side=True)
    for end in islice(cycle((client, server)), 8):
        try:
            end.do_handshake()
        except ssl.SSLWantReadError:
            continue
    return client.version()


@pytest.mark.parametrize("version", [ssl.TLSVersion.TLSv1, ssl.TLSVersion.TLSv1_1])
@pytest.mark.filterwarnings("ignore:ssl.TLSVersion")
def test_nothing_below_1_2(version: ssl.TLSVersion) -> None:
    with pytest.raises(ssl.SSLError, match=r"(?i)version|protocol"):
        agreed(version)


@pytest.mark.parametrize("version", [ssl.TLSVersion.TLSv1_2, ssl.TLSVersion.TLSv1_3])
def test_1_2_and_1_3(version: ssl.TLSVersion) -> None:
    assert agreed(version) == version.name.replace("_", ".")
