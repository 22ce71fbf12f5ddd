"""Downloads over https for the other tools, with the proxies and SSL_CERT_FILE of the environment."""

import os
import ssl
import sys
import urllib.request

TIMEOUT_S = 30
ATTEMPTS = 3


def fetch(url: str) -> bytes:
    """The content of ``url``; ends the program with one line if the download fails."""
    problem: OSError | None = None
    for _ in range(ATTEMPTS):
        try:
            with urllib.request.urlopen(url, timeout=TIMEOUT_S, context=_context()) as answer:  # noqa: S310 - by constants
                return bytes(answer.read())
        except OSError as error:
            problem = error
    sys.exit(f"cannot fetch {url}: {problem}")


def _context() -> ssl.SSLContext:
    """Python reads SSL_CERT_FILE itself; an authority that is configured only for pip is trusted here, too."""
    if "SSL_CERT_FILE" in os.environ:
        return ssl.create_default_context()
    return ssl.create_default_context(cafile=os.environ.get("PIP_CERT"))
