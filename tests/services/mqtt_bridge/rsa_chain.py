"""A broker's certificate as large ones of the internet: RSA, signed by an authority between it and the root."""

from __future__ import annotations

import datetime
import ipaddress
from pathlib import Path
from typing import NamedTuple

_BITS = 2048
_DAY = datetime.timedelta(days=1)


class Chain(NamedTuple):
    """Files. ``sent`` has two certificates, the broker's and that of the authority between."""

    root: Path
    sent: Path
    key: Path


def make(folder: Path, address: str) -> Chain:
    """Write a chain for a broker at this IP address."""
    from cryptography import x509
    from cryptography.hazmat.primitives.asymmetric import rsa
    from cryptography.hazmat.primitives.hashes import SHA256
    from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat

    names = ("Root of a trial", "Authority of a trial", "Broker of a trial")
    subjects = [x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, name)]) for name in names]
    keys = [rsa.generate_private_key(65537, _BITS) for _ in names]
    now, made = datetime.datetime.now(datetime.UTC), list[bytes]()
    for number, (subject, key) in enumerate(zip(subjects, keys, strict=True)):
        signer, is_authority = max(0, number - 1), number < len(names) - 1
        builder = (
            x509.CertificateBuilder()
            .subject_name(subject)
            .issuer_name(subjects[signer])
            .public_key(key.public_key())
            .serial_number(x509.random_serial_number())
            .not_valid_before(now - _DAY)
            .not_valid_after(now + 30 * _DAY)
            .add_extension(x509.BasicConstraints(ca=is_authority, path_length=None), critical=True)
            .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
            .add_extension(
                x509.AuthorityKeyIdentifier.from_issuer_public_key(keys[signer].public_key()), critical=False
            )
        )
        if not is_authority:
            own = x509.SubjectAlternativeName([x509.IPAddress(ipaddress.ip_address(address))])
            builder = builder.add_extension(own, critical=False)
        made.append(builder.sign(keys[signer], SHA256()).public_bytes(Encoding.PEM))
    files = Chain(*(folder / name for name in ("root.pem", "chain.pem", "broker.key")))
    files.root.write_bytes(made[0])
    files.sent.write_bytes(made[2] + made[1])
    files.key.write_bytes(keys[2].private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()))
    files.key.chmod(0o600)
    return files
