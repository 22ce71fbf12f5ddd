"""Certificates for https in a lab without a public authority: their files, names and dates."""

import re
import socket
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

from pebble.config.hosts import HostError
from pebble.config.hosts import host as host_of
from pebble.errors import PebbleError

CA_CERT, CA_KEY, SERVER_CERT, SERVER_KEY = "ca.pem", "ca.key", "server.pem", "server.key"
ACCOUNTS = "accounts"  # folder of the certificates with names of accounts
_CERTIFICATE = re.compile(rb"-----BEGIN CERTIFICATE-----[\w+/=\s]+-----END CERTIFICATE-----", re.ASCII).findall


class CertificateError(PebbleError):
    """An error with a certificate. Example: ``tls/ca.pem exists: …``."""


@dataclass(frozen=True, slots=True)
class Shown:
    """The content of a certificate file."""

    file: Path
    names: tuple[str, ...]  # empty for an authority
    until: datetime
    sha256: str  # of the certificate, as browsers show it

    @property
    def days_left(self) -> float:
        return (self.until - datetime.now(UTC)) / timedelta(days=1)


def init(folder: Path, names: Sequence[str]) -> None:
    """Write a new authority and a server certificate for ``names``. Raises CertificateError; overwrites nothing."""
    from pebble.extensions.fleet import authority  # needs the package cryptography, which a robot may lack

    hosts = hosts_of(names)
    for name in (CA_CERT, CA_KEY, SERVER_CERT, SERVER_KEY):
        if (folder / name).exists():
            raise CertificateError(
                f"{folder / name} exists: `pebble cert renew --folder {folder}` makes a new server certificate, "
                "and another --folder a new authority"
            )
    authority.make(folder / CA_CERT, folder / CA_KEY, hosts)
    renew(folder, hosts)


def renew(folder: Path, names: Sequence[str] = ()) -> None:
    """Write a new server certificate and key by the folder's authority. Raises CertificateError.

    Its names are ``names``, or those of the present certificate.
    """
    from pebble.extensions.fleet import authority

    signer = authority.read(folder / CA_CERT, folder / CA_KEY)
    hosts = hosts_of(names or show(folder / SERVER_CERT).names)
    signer.sign("Pebble operator page", hosts, folder / SERVER_CERT, folder / SERVER_KEY, is_client=False)


def of_account(folder: Path, account: str, hosts: Sequence[str] = ()) -> tuple[Path, Path]:
    """Write a certificate with the name of an account, and its key. Raises CertificateError.

    ``hosts``: addresses at which the account itself listens, as a robot's hub does.
    """
    from pebble.extensions.fleet import authority

    files = folder / ACCOUNTS / f"{account}.pem", folder / ACCOUNTS / f"{account}.key"
    signer = authority.read(folder / CA_CERT, folder / CA_KEY)
    files[0].parent.mkdir(mode=0o700, exist_ok=True)
    signer.sign(account, hosts_of(hosts) if hosts else [], *files, is_client=True)
    return files


def show(file: Path) -> Shown:
    """Return the content of a certificate file. Raises CertificateError."""
    from pebble.extensions.fleet import authority

    return authority.show(file)


def only_certificates(content: bytes) -> bytes:
    """Return only the certificates in the content of a file.

    They are sent to others, and a config may name any file.
    """
    return b"\n".join([*_CERTIFICATE(content), b""])


def own_names() -> list[str]:
    """Return the names under which other machines probably reach this one."""
    names = [f"{socket.gethostname().partition('.')[0].lower()}.local"]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))  # sends nothing; the kernel chooses the address of the way out
            names.append(probe.getsockname()[0])
        except OSError:
            pass
    return names


def hosts_of(names: Iterable[str]) -> list[str]:
    """Return host names and addresses without duplicates, each in its usual spelling. Raises CertificateError."""
    try:
        hosts = list(dict.fromkeys(host_of(name).lower() for name in names))
    except HostError as error:
        raise CertificateError(f"a certificate's name {error}") from None
    if not hosts:
        raise CertificateError("name the addresses by which browsers reach the server: robot-lab.local 192.168.1.20")
    for host in hosts:
        if "%" in host or "_" in host:
            raise CertificateError(f"{host}: leave it out, a certificate cannot hold names with % or _")
    return hosts
