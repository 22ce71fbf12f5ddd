"""Opens the demo's page to phones: a certificate, a person, and a QR code with the page's address."""

import secrets
import sys
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any, Final

import numpy as np
from cv2 import QRCodeEncoder
from rich.console import Console
from rich.text import Text

from pebble.errors import PebbleError
from pebble.extensions.fleet import certificates
from pebble.extensions.fleet.certificates import CA_CERT, SERVER_CERT, SERVER_KEY, own_names
from pebble.extensions.fleet.people import People
from pebble.extensions.fleet.roles import Role

NAME: Final = "visitor"
_QUIET: Final = 4  # modules around a QR code, ISO/IEC 18004
#: Two rows of modules in a line of text: dark ones of the upper, of the lower.
_BLOCKS: Final = {(False, False): " ", (True, False): "▀", (False, True): "▄", (True, True): "█"}


def require_terminal() -> None:
    """Raise PebbleError if the output is no terminal: a password must not end in a file."""
    if not sys.stdout.isatty():
        raise PebbleError("--phone prints a password, to a terminal only: start the demo in one, without a pipe")


class Phone:
    """The certificate and the person for the page, below ``folder``; ``settings`` are fields of WebSettings."""

    def __init__(self, folder: Path) -> None:
        self._tls, people = folder / "tls", folder / "people.sqlite"
        # The page's address has the first name: the IP address, which own_names has last, if there is one.
        names = [*reversed(own_names()), "localhost", "127.0.0.1"]
        certificates.init(self._tls, names)
        self._password = secrets.token_hex(4)
        with closing(People(people)) as database:
            database.add(NAME, self._password, Role.DRIVER)
        self.settings: dict[str, Any] = {
            "host": "0.0.0.0",  # noqa: S104 - the phone is another machine
            "login": True,
            "people": people,
            "certificate": self._tls / SERVER_CERT,
            "key": self._tls / SERVER_KEY,
            "authority": self._tls / CA_CERT,
        }

    def show(self, url: str, console: Console) -> None:
        """Print the QR code, the person's name and the password."""
        show_qr(url, console)
        lines = [
            "All of this machine's network can open the page, but not the broker: for a phone in the same Wi-Fi.",
            f"Log in as {NAME} with the password {self._password}",
            "The browser warns of a certificate that it does not know: the demo has made it. Its SHA-256 is",
            certificates.show(self._tls / SERVER_CERT).sha256,
        ]
        for line in lines:
            console.print(line, highlight=False, markup=False, soft_wrap=True)


def show_qr(text: str, console: Console) -> None:
    """Print a QR code, black on white in any terminal: most phones read no other."""
    for line in qr_lines(text):
        console.print(Text(line, style="#000000 on #ffffff", no_wrap=True, overflow="ignore", end="\n"), crop=False)


def qr_lines(text: str) -> Iterator[str]:
    """Yield a QR code in black blocks on white."""
    dark = QRCodeEncoder.create().encode(text) == 0
    used = np.argwhere(dark)
    first, end = used.min(), used.max() + 1  # the code is a square, perhaps with white around it
    dark = np.pad(dark[first:end, first:end], _QUIET)
    if len(dark) % 2:  # two rows become one line
        dark = np.pad(dark, ((0, 1), (0, 0)))
    for upper, lower in zip(dark[::2], dark[1::2], strict=True):
        yield "".join(_BLOCKS[bool(above), bool(below)] for above, below in zip(upper, lower, strict=True))
