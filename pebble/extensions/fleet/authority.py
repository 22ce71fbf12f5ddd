"""A small certificate authority, made by the package cryptography. It signs only for machines of its own network."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from ipaddress import ip_address, ip_network
from pathlib import Path
from typing import Any

from cryptography import x509
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat, load_pem_private_key

from pebble.config.visible import shown
from pebble.extensions.fleet.certificates import CertificateError, Shown
from pebble.ownership import read_plain
from pebble.runtime.whole_file import write

SERVER_DAYS = 397  # the longest that browsers accept
_AUTHORITY_DAYS = 3650
_CLOCKS_DIFFER = timedelta(hours=1)
#: What an authority may sign for, besides the names it is made for. Whatever happens to its key, a phone that trusts it
#: accepts no certificate of it for a bank.
_DOMAINS = ("local", "localhost", "lan", "internal", "home.arpa")
_IPV4 = ("127.0.0.0/8", "10.0.0.0/8", "172.16.0.0/12", "192.168.0.0/16", "169.254.0.0/16", "100.64.0.0/10")
_IPV6 = ("::1/128", "fc00::/7", "fe80::/10")


@dataclass(frozen=True)
class Authority:
    """A certificate that others trust, and its key."""

    certificate: x509.Certificate
    key: ec.EllipticCurvePrivateKey
    file: Path

    def sign(self, name: str, hosts: Sequence[str], file: Path, key_file: Path, *, is_client: bool) -> None:
        """Write a certificate and a new key, for a machine that listens at ``hosts``, or that logs in, or both.

        ``name`` must not look like a host: OpenSSL would apply the authority's name constraints to it. Raises
        CertificateError for hosts for which it may not sign.
        """
        _check_permitted(self, hosts)
        usages = [x509.oid.ExtendedKeyUsageOID.SERVER_AUTH] if hosts else []
        usages += [x509.oid.ExtendedKeyUsageOID.CLIENT_AUTH] if is_client else []
        identifier = x509.AuthorityKeyIdentifier.from_issuer_public_key(self.key.public_key())
        extensions: list[x509.ExtensionType] = [x509.ExtendedKeyUsage(usages), identifier]
        extensions += [x509.SubjectAlternativeName(_general_names(hosts))] if hosts else []
        _write(file, key_file, name, extensions, issuer=self)


def make(file: Path, key_file: Path, hosts: Sequence[str]) -> None:
    """Write a new authority, which may sign for ``hosts`` and names of local networks. Raises CertificateError."""
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise CertificateError(f"{file.parent}: {error.strerror}") from None
    permitted = dict.fromkeys(_general_names((*_DOMAINS, *_IPV4, *_IPV6, *hosts), networks=True))
    constraints = x509.NameConstraints(list(permitted), None)
    _write(file, key_file, f"Pebble authority of {hosts[0]}"[:64], [constraints])


def read(file: Path, key_file: Path) -> Authority:
    """Return the authority in these two files. Raises CertificateError."""
    certificate = certificate_in(file)
    try:
        key: Any = load_pem_private_key(read_plain(key_file), None)
    except (OSError, ValueError, TypeError) as error:
        raise CertificateError(f"{key_file}: {getattr(error, 'strerror', error)}") from None
    if key.public_key() != certificate.public_key():
        raise CertificateError(f"{key_file} is not the key of {file}")
    return Authority(certificate, key, file)


def certificate_in(file: Path) -> x509.Certificate:
    """Return the certificate in a file. Raises CertificateError."""
    try:
        return x509.load_pem_x509_certificate(read_plain(file))
    except OSError as error:
        raise CertificateError(f"{file}: {error.strerror}; `pebble cert init` makes certificates") from None
    except ValueError:
        raise CertificateError(f"{file} holds no certificate") from None


def show(file: Path) -> Shown:
    """Return the content of a certificate file. Raises CertificateError."""
    certificate = certificate_in(file)
    values = (extension.value for extension in certificate.extensions)
    names = (name for value in values if isinstance(value, x509.SubjectAlternativeName) for name in value)
    sha256 = certificate.fingerprint(SHA256()).hex(":").upper()
    return Shown(file, tuple(shown(str(name.value)) for name in names), certificate.not_valid_after_utc, sha256)


def _general_names(hosts: Iterable[str], *, networks: bool = False) -> list[x509.GeneralName]:
    read_ip = ip_network if networks else ip_address
    return [x509.IPAddress(read_ip(host)) if _is_address(host) else x509.DNSName(host) for host in hosts]


def _is_address(host: str) -> bool:
    return ":" in host or host.rpartition(".")[2][:1].isdecimal()  # no name ends in a number


def _check_permitted(authority: Authority, hosts: Sequence[str]) -> None:
    """Raise CertificateError for a host outside of the authority's name constraints."""
    constraints = authority.certificate.extensions.get_extension_for_class(x509.NameConstraints).value
    permitted = constraints.permitted_subtrees or ()
    domains = [f".{name.value}" for name in permitted if isinstance(name, x509.DNSName)]
    networks: list[Any] = [name.value for name in permitted if isinstance(name, x509.IPAddress)]
    for host in hosts:
        if _is_address(host):
            is_permitted = any(ip_address(host) in network for network in networks)
        else:
            is_permitted = f".{host}".endswith(tuple(domains))
        if not is_permitted:
            raise CertificateError(
                f"the authority in {authority.file.parent} may not sign for {host}, only for addresses of local "
                f"networks, names that end in {', '.join(_DOMAINS)}, and those it was made for: use one, or make "
                "another authority"
            )


def _write(
    file: Path, key_file: Path, name: str, extensions: Iterable[x509.ExtensionType], issuer: Authority | None = None
) -> None:
    """Write a new key and its certificate. Without an ``issuer`` it is an authority, which signs itself."""
    key, now = ec.generate_private_key(ec.SECP256R1()), datetime.now(UTC)
    subject = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, name)])
    # it begins earlier, for clocks that are late, so it also ends earlier: browsers accept no more days in all
    until = now + timedelta(days=SERVER_DAYS if issuer else _AUTHORITY_DAYS) - _CLOCKS_DIFFER
    other_usages = ("content_commitment", "key_encipherment", "data_encipherment", "key_agreement")
    not_used = dict.fromkeys((*other_usages, "encipher_only", "decipher_only"), False)
    is_authority = issuer is None
    usage = x509.KeyUsage(
        digital_signature=not is_authority, key_cert_sign=is_authority, crl_sign=is_authority, **not_used
    )
    builder = (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer.certificate.subject if issuer else subject)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - _CLOCKS_DIFFER)
        .not_valid_after(min(until, issuer.certificate.not_valid_after_utc) if issuer else until)
        .add_extension(x509.BasicConstraints(ca=is_authority, path_length=0 if is_authority else None), critical=True)
        .add_extension(usage, critical=True)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
    )
    for extension in extensions:
        builder = builder.add_extension(extension, critical=isinstance(extension, x509.NameConstraints))
    certificate = builder.sign(issuer.key if issuer else key, SHA256())
    private = key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
    write(key_file, private, 0o600, CertificateError)
    write(file, certificate.public_bytes(Encoding.PEM), 0o644, CertificateError)
