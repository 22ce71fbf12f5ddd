"""Releases of a few bytes, signed as minisign signs. Its own secret key files, which need a password, are not used."""

from __future__ import annotations

import base64
import hashlib
import json
import secrets
from pathlib import Path
from typing import Any

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from pebble.extensions.install.update.release import MANIFEST, SIGNATURE, TEST_ID

WHEEL = "pebble_robot-0.3.0-py3-none-any.whl"


class Key:
    """A key for minisign. Everybody can derive the test key."""

    def __init__(self, secret: bytes, key_id: bytes) -> None:
        self._secret, self._id = Ed25519PrivateKey.from_private_bytes(secret), key_id

    @classmethod
    def test(cls) -> Key:
        return cls(hashlib.sha256(b"Pebble's test key").digest(), TEST_ID)

    @classmethod
    def fresh(cls) -> Key:
        return cls(secrets.token_bytes(32), secrets.token_bytes(8))

    @property
    def public(self) -> str:
        return base64.b64encode(b"Ed" + self._id + self._secret.public_key().public_bytes_raw()).decode()

    def sign(self, path: Path, comment: str = "of a test") -> None:
        """Write the ``.minisig`` of a file."""
        signature = self._secret.sign(hashlib.blake2b(path.read_bytes()).digest())
        whole = self._secret.sign(signature + comment.encode())
        first = base64.b64encode(b"ED" + self._id + signature).decode()
        lines = ("untrusted comment: of a test", first, f"trusted comment: {comment}", base64.b64encode(whole).decode())
        path.with_name(f"{path.name}.minisig").write_text("".join(f"{line}\n" for line in lines))


def release(folder: Path, key: Key, **changes: Any) -> Path:
    """Write a release of two small files, signed by ``key``; return its folder. ``changes``: fields of RELEASE.json."""
    folder.mkdir()
    files = {WHEEL: b"a wheel", "robot.txt": b"its packages\n"}
    for name, data in files.items():
        (folder / name).write_bytes(data)
    fields = {
        "version": "0.3.0", "sequence": 12, "from": "0.1.0", "python": ">=3.11",
        "files": {name: hashlib.sha256(data).hexdigest() for name, data in files.items()},
        "keys": [key.public],
    }  # fmt: skip
    (folder / MANIFEST).write_text(json.dumps(fields | changes))
    key.sign(folder / MANIFEST)
    assert (folder / SIGNATURE).exists()
    return folder
