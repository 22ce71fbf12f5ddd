"""The certificates of the small authority: a real TLS client accepts them, and only for their names."""

from __future__ import annotations

import datetime
import shutil
import socket
import ssl
import stat
import subprocess
import threading
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives.hashes import SHA256

from pebble.extensions.fleet import authority
from pebble.extensions.fleet.certificates import CertificateError, init, renew, show


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    init(tmp_path / "tls", ["Lab.local", "192.168.1.20", "127.0.0.1", "::1", "pebble.example.org"])
    return tmp_path / "tls"


def connect(folder: Path, name: str) -> str:
    """A TLS handshake as a browser does it; "" or why it failed."""
    server = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
    server.load_cert_chain(folder / "server.pem", folder / "server.key")
    client = ssl.create_default_context(cafile=folder / "ca.pem")
    client.verify_flags |= ssl.VERIFY_X509_STRICT
    ours, theirs = socket.socketpair()

    def serve() -> None:
        try:
            server.wrap_socket(theirs, server_side=True).close()
        except OSError:
            theirs.close()

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        client.wrap_socket(ours, server_hostname=name).close()
    except ssl.SSLCertVerificationError as error:
        return error.verify_message
    finally:
        ours.close()
        thread.join()
    return ""


@pytest.mark.parametrize("name", ["lab.local", "192.168.1.20", "::1", "pebble.example.org"])
def test_clients_that_trust_the_authority_accept_each_name(folder: Path, name: str) -> None:
    assert connect(folder, name) == ""


@pytest.mark.parametrize("name", ["192.168.1.20", "::1", "lab.local"])
def test_one_name_is_enough(tmp_path: Path, name: str) -> None:
    init(tmp_path, [name])
    assert connect(tmp_path, name) == ""


def test_keys_are_for_their_owner_and_certificates_for_all(folder: Path) -> None:
    modes = {path.name: stat.S_IMODE(path.stat().st_mode) for path in folder.iterdir()}
    assert modes == {"ca.pem": 0o644, "ca.key": 0o600, "server.pem": 0o644, "server.key": 0o600}


def test_nothing_is_overwritten(folder: Path) -> None:
    before = {path: path.read_bytes() for path in folder.iterdir()}
    with pytest.raises(CertificateError, match=r"ca\.pem exists: `pebble cert renew --folder"):
        init(folder, ["lab.local"])
    (folder / "ca.pem").unlink()
    with pytest.raises(CertificateError, match=r"ca\.key exists"):
        init(folder, ["lab.local"])
    assert all(path.read_bytes() == content for path, content in before.items() if path.name != "ca.pem")


def test_what_is_shown(folder: Path) -> None:
    server = show(folder / "server.pem")
    assert server.names == ("lab.local", "192.168.1.20", "127.0.0.1", "::1", "pebble.example.org")
    left = server.until - datetime.datetime.now(datetime.UTC)
    assert datetime.timedelta(days=396) < left < datetime.timedelta(days=397)
    authority = show(folder / "ca.pem")
    assert authority.until > server.until + datetime.timedelta(days=3000)
    content = x509.load_pem_x509_certificate((folder / "ca.pem").read_bytes())
    assert authority.sha256.replace(":", "").lower() == content.fingerprint(SHA256()).hex()


def test_renewal_has_a_new_key_the_same_names_and_the_same_authority(folder: Path) -> None:
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    renew(folder)
    after = {path.name: path.read_bytes() for path in folder.iterdir()}
    assert {name for name in before if before[name] != after[name]} == {"server.pem", "server.key"}
    assert show(folder / "server.pem").names[0] == "lab.local"
    assert connect(folder, "lab.local") == ""


@pytest.mark.parametrize("name", ["bank.example.com", "8.8.8.8", "2001:db8::1", "notlocal"])
def test_an_authority_does_not_sign_for_foreign_names(folder: Path, name: str) -> None:
    before = (folder / "server.pem").read_bytes()
    with pytest.raises(CertificateError, match=f"may not sign for {name}, only for"):
        renew(folder, [name])
    assert (folder / "server.pem").read_bytes() == before


def test_clients_refuse_what_a_stolen_authority_signs_for_foreign_names(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(authority, "_check_permitted", lambda *_: None)
    renew(folder, ["bank.example.com", "8.8.8.8"])
    assert connect(folder, "bank.example.com") == "permitted subtree violation"
    assert connect(folder, "8.8.8.8") == "permitted subtree violation"


@pytest.mark.parametrize(
    "name", ["", "https://lab.local", "lab.local:8080", "-x.local", "*.local", "1.2.3", "fe80::1%eth0"]
)
def test_odd_names_are_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(CertificateError, match="a certificate"):
        init(tmp_path, [name])
    assert list(tmp_path.iterdir()) == []


def test_a_name_is_needed(tmp_path: Path) -> None:
    with pytest.raises(CertificateError, match="name the addresses"):
        init(tmp_path, [])


def test_missing_and_broken_files(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(CertificateError, match=r"ca\.pem: No such file or directory; `pebble cert init`"):
        renew(tmp_path)
    shutil.copy(folder / "server.key", folder / "ca.key")
    with pytest.raises(CertificateError, match=r"ca\.key is not the key of .*ca\.pem"):
        renew(folder)
    (folder / "ca.key").write_text("nothing")
    with pytest.raises(CertificateError, match=r"ca\.key: "):
        renew(folder)
    (folder / "ca.pem").write_text("nothing")
    with pytest.raises(CertificateError, match=r"ca\.pem holds no certificate"):
        show(folder / "ca.pem")


def test_openssl_finds_nothing_wrong(folder: Path) -> None:
    openssl = shutil.which("openssl")
    assert openssl, "openssl is not installed"
    arguments = ["verify", "-x509_strict", "-purpose", "sslserver", "-CAfile", "ca.pem", "server.pem"]
    result = subprocess.run([openssl, *arguments], cwd=folder, capture_output=True, text=True, check=False)
    assert (result.returncode, result.stdout.strip()) == (0, "server.pem: OK")
