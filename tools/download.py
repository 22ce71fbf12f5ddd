"""Downloads over https for the scripts beside it; proxies and SSL_CERT_FILE of the environment count."""

import os
import ssl
import sys
import urllib.request

TIMEOUT_S = 30
ATTEMPTS = 3


def fetch(url: str) -> bytes:
    """What is at ``url``; ends the program with one line when it cannot be had."""
    problem: OSError | None = None
    for _ in range(ATTEMPTS):
        try:
            with urllib.request.urlopen(url, timeout=TIMEOUT_S, context=_context()) as answer:  # noqa: S310 - by constants
                return bytes(answer.read())
        except OSError as error:
            problem = error
    sys.exit(f"cannot fetch {url}: {problem}")


def _context() -> ssl.SSLContext:
    """SSL_CERT_FILE is Python's own; whoever told only pip of an authority means this as well."""
    if "SSL_CERT_FILE" in os.environ:
        return ssl.create_default_context()
    return ssl.create_default_context(cafile=os.environ.get("PIP_CERT"))
