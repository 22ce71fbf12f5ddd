"""``pebble cert``: certificates of one's own for the operator page."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from pebble.errors import PebbleError
from pebble.extensions.fleet import certificates
from pebble.extensions.operator.client.page_packages import require_packages
from pebble.extensions.page.commands.people import TLS, default_folder
from pebble.runtime.as_owner import as_owner

_HELP = """Certificates of one's own, for the operator page by https.

\b
    pebble cert init lab-pc.local 192.168.1.20
    pebble web goob.json --host 0.0.0.0
    pebble cert show
    pebble cert renew
"""
_TRUST = """\
Each browser trusts the authority once, from the port of `pebble web`. Compare the fingerprint before you do:
    {sha256}
    iPhone, iPad   open https://{name}:PORT/ca.pem, install the profile in Settings, then switch it on in
                   General > About > Certificate Trust Settings
    Android        download it there, then Settings > Security > Encryption & credentials > Install a certificate > CA
    Firefox        Settings > Privacy & Security > View Certificates > Authorities > Import
    Chrome         chrome://certificate-manager > Installed by you > Import
    Debian         cp ca.pem /usr/local/share/ca-certificates/pebble.crt && update-ca-certificates
"""
_Folder = Annotated[
    Path | None, typer.Option(help="Folder of the certificates and keys.", metavar="FOLDER", show_default=False)
]
_Names = Annotated[
    list[str],
    typer.Argument(help="Host names and IP addresses by which browsers reach it.", metavar="NAME…", show_default=False),
]
_NewNames = Annotated[
    list[str] | None, typer.Argument(help="Other names than before.", metavar="NAME…", show_default=False)
]


def init(names: _Names, folder: _Folder = None) -> int:
    """Make a certificate authority and a certificate for this machine's names.

    The authority signs for these names and for local ones only: a phone that trusts it trusts it for nothing else.
    Keep ca.key secret: with it one can imitate the operator page.

    \b
        pebble cert init lab-pc.local 192.168.1.20
    """
    with _opened(folder, make=True) as place:
        certificates.init(place, names)
        signed = certificates.show(place / certificates.SERVER_CERT).names
        typer.echo(f"{place} has a certificate for {', '.join(signed)}.")
        typer.echo(f"Next:\n    pebble web CONFIG --host 0.0.0.0 --tls {place}")
        _print_trust(place)
    return 0


def renew(names: _NewNames = None, folder: _Folder = None) -> int:
    """Make a new server certificate by the same authority, which browsers trust already; restart `pebble web` then."""
    with _opened(folder) as place:
        certificates.renew(place, names or ())
        shown = certificates.show(place / certificates.SERVER_CERT)
    typer.echo(f"{shown.file} is for {', '.join(shown.names)} until {shown.until:%Y-%m-%d}; restart `pebble web`")
    return 0


def show(folder: _Folder = None) -> int:
    """Print names, dates and fingerprints, and how browsers trust the authority."""
    with _opened(folder) as place:
        for file in (certificates.CA_CERT, certificates.SERVER_CERT):
            shown = certificates.show(place / file)
            typer.echo(f"{shown.file}\n    {'for ' + ', '.join(shown.names) if shown.names else 'authority'}")
            typer.echo(f"    until {shown.until:%Y-%m-%d}\n    SHA-256 {shown.sha256}")
        _print_trust(place)
    return 0


def register(app: typer.Typer) -> None:
    group = typer.Typer(help=_HELP, rich_markup_mode=None)
    group.command("init")(init)
    group.command("renew")(renew)
    group.command("show")(show)
    app.add_typer(group, name="cert")


@contextmanager
def _opened(folder: Path | None, *, make: bool = False) -> Iterator[Path]:
    require_packages()
    place = (folder or default_folder() / TLS).absolute()
    with as_owner(place, "pebble.extensions.fleet.authority", make=make):
        yield place


def _print_trust(place: Path) -> None:
    authority = certificates.show(place / certificates.CA_CERT)
    names = certificates.show(place / certificates.SERVER_CERT).names
    if not names:
        raise PebbleError(f"{place / certificates.SERVER_CERT} names no host: `pebble cert renew NAME…`")
    typer.echo(_TRUST.format(sha256=authority.sha256, name=f"[{names[0]}]" if ":" in names[0] else names[0]), nl=False)
