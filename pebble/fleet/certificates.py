"""A small certificate authority of one's own, so that browsers and phones in a lab can use https."""

from __future__ import annotations

import datetime
import ipaddress
import re
import socket
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from pebble.config.hosts import HostError
from pebble.config.hosts import host as host_of
from pebble.errors import PebbleError
from pebble.fleet.whole_file import write

if TYPE_CHECKING:
    from cryptography import x509
    from cryptography.hazmat.primitives.asymmetric.ec import EllipticCurvePrivateKey

CA_CERT, CA_KEY, SERVER_CERT, SERVER_KEY = "ca.pem", "ca.key", "server.pem", "server.key"
ACCOUNTS = "accounts"  # folder of the certificates with names of accounts
SERVER_DAYS = 397  # the longest that browsers accept
AUTHORITY_DAYS = 3650
_HOST = re.compile(r"(?=.{1,253}$)([a-z0-9]([a-z0-9-]{0,61}[a-z0-9])?)(\.[a-z0-9]([a-z0-9-]{0,61}[a-z0-9])?)*")
_CLOCKS_DIFFER = datetime.timedelta(hours=1)
#: What an authority may sign for, besides the names it is made for. Whatever happens to its key, a phone that trusts it
#: accepts no certificate of it for a bank.
_LOCAL_DOMAINS = ("local", "localhost", "lan", "internal", "home.arpa")
_LOCAL_NETWORKS = (
    "127.0.0.0/8",
    "10.0.0.0/8",
    "172.16.0.0/12",
    "192.168.0.0/16",
    "169.254.0.0/16",
    "100.64.0.0/10",
    "::1/128",
    "fc00::/7",
    "fe80::/10",
)


class CertificateError(PebbleError):
    """Certificates cannot be made or read. Example: ``tls/ca.pem exists: …``."""


@dataclass(frozen=True, slots=True)
class Shown:
    """What one certificate file holds."""

    file: Path
    names: tuple[str, ...]  # empty for an authority
    until: datetime.datetime
    sha256: str  # of the certificate, as browsers show it

    @property
    def days_left(self) -> float:
        return (self.until - datetime.datetime.now(datetime.UTC)) / datetime.timedelta(days=1)


def init(folder: Path, names: Sequence[str]) -> None:
    """Write a new authority and a server certificate for ``names``. Raises CertificateError; overwrites nothing."""
    hosts = _hosts(names)
    for name in (CA_CERT, CA_KEY, SERVER_CERT, SERVER_KEY):
        if (folder / name).exists():
            raise CertificateError(
                f"{folder / name} exists: `pebble cert renew --folder {folder}` makes a new server certificate, "
                "and another --folder a new authority"
            )
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise CertificateError(f"{folder}: {error.strerror}") from None
    key, certificate = _authority(hosts)
    _write_key(folder / CA_KEY, key)
    write(folder / CA_CERT, _pem(certificate), 0o644, CertificateError)
    _sign(folder, key, certificate, hosts)


def renew(folder: Path, names: Sequence[str] = ()) -> None:
    """A new server certificate and key by the same authority, for ``names`` or those of before.

    Raises CertificateError.
    """
    key, authority = _existing(folder)
    _sign(folder, key, authority, _hosts(names or show(folder / SERVER_CERT).names))


def of_account(folder: Path, account: str, hosts: Sequence[str] = ()) -> tuple[Path, Path]:
    """Write a certificate with the name of an account, and its key. Raises CertificateError.

    ``hosts``: where it listens itself, as the hub of a robot does.
    """
    key, authority = _existing(folder)
    place = folder / ACCOUNTS
    place.mkdir(mode=0o700, exist_ok=True)
    files = place / f"{account}.pem", place / f"{account}.key"
    _write_signed(folder, key, authority, account, _hosts(hosts) if hosts else (), files, client=True)
    return files


def show(file: Path) -> Shown:
    """Raises CertificateError."""
    from cryptography.hazmat.primitives.hashes import SHA256

    certificate = _read(file)
    digest = certificate.fingerprint(SHA256()).hex().upper()
    pairs = (digest[place : place + 2] for place in range(0, len(digest), 2))
    return Shown(file, _names_of(certificate), certificate.not_valid_after_utc, ":".join(pairs))


def own_names() -> list[str]:
    """Names by which other machines probably reach this one."""
    names = [f"{socket.gethostname().partition('.')[0].lower()}.local"]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))  # sends nothing; the kernel chooses the address of the way out
            names.append(probe.getsockname()[0])
        except OSError:
            pass
    return names


# -- inside


def _existing(folder: Path) -> tuple[EllipticCurvePrivateKey, x509.Certificate]:
    """The authority of a folder. Raises CertificateError."""
    from cryptography.hazmat.primitives.serialization import load_pem_private_key

    authority = _read(folder / CA_CERT)
    try:
        key = load_pem_private_key((folder / CA_KEY).read_bytes(), None)
    except (OSError, ValueError, TypeError) as error:
        raise CertificateError(f"{folder / CA_KEY}: {getattr(error, 'strerror', error)}") from None
    if key.public_key() != authority.public_key():
        raise CertificateError(f"{folder / CA_KEY} is not the key of {folder / CA_CERT}")
    return key, authority  # type: ignore[return-value]


def _hosts(names: Iterable[str]) -> list[str]:
    hosts = list(dict.fromkeys(_host(name) for name in names))
    if not hosts:
        raise CertificateError("name the addresses by which browsers reach the server: robot-lab.local 192.168.1.20")
    return hosts


def _host(name: str) -> str:
    """A host name or IP address in its one spelling. Raises CertificateError."""
    try:
        host = host_of(name).lower()
    except HostError as error:
        raise CertificateError(f"a certificate's name {error}") from None
    if "%" in host or not (":" in host or _HOST.fullmatch(host)):
        raise CertificateError(f"{host}: a certificate names no network card and no _, leave out what has one")
    return str(ipaddress.ip_address(host)) if ":" in host else host


def _authority(hosts: Sequence[str]) -> tuple[EllipticCurvePrivateKey, x509.Certificate]:
    from cryptography import x509
    from cryptography.hazmat.primitives.asymmetric import ec

    key = ec.generate_private_key(ec.SECP256R1())
    subject = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, f"Pebble authority of {hosts[0]}"[:64])])
    domains = [x509.DNSName(host) for host in dict.fromkeys((*_LOCAL_DOMAINS, *filter(_is_name, hosts)))]
    own = (str(ipaddress.ip_network(host)) for host in hosts if not _is_name(host))
    networks = [x509.IPAddress(ipaddress.ip_network(net)) for net in dict.fromkeys((*_LOCAL_NETWORKS, *own))]
    builder = (
        _builder(subject, subject, key, AUTHORITY_DAYS)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(_key_usage(signs_certificates=True), critical=True)
        .add_extension(x509.NameConstraints([*domains, *networks], None), critical=True)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
    )
    return key, _signed(builder, key)


def _sign(folder: Path, key: EllipticCurvePrivateKey, authority: x509.Certificate, hosts: Sequence[str]) -> None:
    # no host name: OpenSSL applies the constraints for names to one that is an address
    _write_signed(
        folder, key, authority, "Pebble operator page", hosts, (folder / SERVER_CERT, folder / SERVER_KEY), client=False
    )


def _write_signed(
    folder: Path,
    key: EllipticCurvePrivateKey,
    authority: x509.Certificate,
    name: str,
    hosts: Sequence[str],
    files: tuple[Path, Path],
    *,
    client: bool,
) -> None:
    from cryptography import x509
    from cryptography.hazmat.primitives.asymmetric import ec

    _check_permitted(folder, authority, hosts)
    own = ec.generate_private_key(ec.SECP256R1())
    subject = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, name)])
    usages = ([x509.oid.ExtendedKeyUsageOID.SERVER_AUTH] if hosts else []) + (
        [x509.oid.ExtendedKeyUsageOID.CLIENT_AUTH] if client else []
    )
    public = authority.public_key()
    builder = (
        _builder(subject, authority.subject, own, SERVER_DAYS, authority.not_valid_after_utc)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(_key_usage(signs_certificates=False), critical=True)
        .add_extension(x509.ExtendedKeyUsage(usages), critical=False)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(own.public_key()), critical=False)
        .add_extension(x509.AuthorityKeyIdentifier.from_issuer_public_key(public), critical=False)  # type: ignore[arg-type]
    )
    if hosts:
        names = [x509.DNSName(host) if _is_name(host) else x509.IPAddress(ipaddress.ip_address(host)) for host in hosts]
        builder = builder.add_extension(x509.SubjectAlternativeName(names), critical=False)
    certificate = _signed(builder, key)
    _write_key(files[1], own)
    write(files[0], _pem(certificate), 0o644, CertificateError)


def _check_permitted(folder: Path, authority: x509.Certificate, hosts: Iterable[str]) -> None:
    from cryptography import x509

    permitted = authority.extensions.get_extension_for_class(x509.NameConstraints).value.permitted_subtrees or []
    values = [name.value for name in permitted]
    for host in hosts:
        if _is_name(host):
            fits = any(host == value or host.endswith(f".{value}") for value in values if isinstance(value, str))
        else:
            address = ipaddress.ip_address(host)
            fits = any(address in value for value in values if not isinstance(value, str))
        if not fits:
            raise CertificateError(
                f"the authority in {folder} may not sign for {host}, only for addresses of local networks, names that "
                f"end in {', '.join(_LOCAL_DOMAINS)}, and those it was made for: use one, or make another authority"
            )


def _builder(
    subject: x509.Name,
    issuer: x509.Name,
    key: EllipticCurvePrivateKey,
    days: int,
    latest: datetime.datetime | None = None,
) -> x509.CertificateBuilder:
    from cryptography import x509

    now = datetime.datetime.now(datetime.UTC)
    until = now + datetime.timedelta(days=days) - _CLOCKS_DIFFER
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - _CLOCKS_DIFFER)
        .not_valid_after(until if latest is None else min(until, latest))
    )


def _signed(builder: x509.CertificateBuilder, key: EllipticCurvePrivateKey) -> x509.Certificate:
    from cryptography.hazmat.primitives.hashes import SHA256

    return builder.sign(key, SHA256())


def _key_usage(*, signs_certificates: bool) -> x509.KeyUsage:
    from cryptography import x509

    others = ("content_commitment", "key_encipherment", "data_encipherment", "key_agreement")
    return x509.KeyUsage(
        digital_signature=not signs_certificates,
        key_cert_sign=signs_certificates,
        crl_sign=signs_certificates,
        **dict.fromkeys((*others, "encipher_only", "decipher_only"), False),
    )


def _is_name(host: str) -> bool:
    try:
        ipaddress.ip_address(host)
    except ValueError:
        return True
    return False


def _names_of(certificate: x509.Certificate) -> tuple[str, ...]:
    from cryptography import x509

    try:
        names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        return ()
    return tuple(str(name.value) for name in names if isinstance(name, x509.DNSName | x509.IPAddress))


def _read(file: Path) -> x509.Certificate:
    from cryptography import x509

    try:
        return x509.load_pem_x509_certificate(file.read_bytes())
    except OSError as error:
        raise CertificateError(f"{file}: {error.strerror}; `pebble cert init` makes certificates") from None
    except ValueError:
        raise CertificateError(f"{file} holds no certificate") from None


def _pem(certificate: x509.Certificate) -> bytes:
    from cryptography.hazmat.primitives.serialization import Encoding

    return certificate.public_bytes(Encoding.PEM)


def _write_key(file: Path, key: EllipticCurvePrivateKey) -> None:
    from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat

    write(file, key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()), 0o600, CertificateError)
