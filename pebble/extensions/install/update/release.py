"""Verifies a release: a folder with RELEASE.json, its signature in minisign's format, and the files that it names.

``python -m pebble.update.release FOLDER --trusted FOLDER --above FILE``: the keys are those of the release that runs,
and the file has the highest sequence that was ever accepted here. It ends with 1 and the reason on stderr.
"""

import argparse
import base64
import binascii
import hashlib
import re
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path

import msgspec
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey

from pebble.errors import PebbleError
from pebble.ownership import open_plain
from pebble.version import __version__

MANIFEST, SIGNATURE = "RELEASE.json", "RELEASE.json.minisig"
#: The key id, free to choose in minisign's format, of keys whose private half is public.
TEST_ID = b"TEST-KEY"
_MOST_BYTES = {MANIFEST: 65_536, SIGNATURE: 1_024, "": 50_000_000}  # "": a file that the manifest names
_UNTRUSTED, _TRUSTED = "untrusted comment: ", "trusted comment: "
_ID_END, _SIGNED_BYTES = 10, 74  # the end of a kind of two bytes and the key id after it; a whole signature
_WHEEL = re.compile(r"pebble_robot-[0-9A-Za-z.+]+-py3-none-any\.whl")


class ReleaseError(PebbleError):
    """An error: a release is refused. The message says why."""


class Release(msgspec.Struct, frozen=True):
    """The content of RELEASE.json. A later version may add fields."""

    version: str
    sequence: int
    oldest: str = msgspec.field(name="from")
    python: str
    files: dict[str, str]
    keys: tuple[str, ...]


def verify(folder: Path, keys: Iterable[str], *, above: int = 0, test_key: bool = False) -> Release:
    """Return the release in ``folder`` if it is newer, and it and all its files are signed by one of ``keys``.

    ``above`` is the highest sequence number that was accepted before. ``test_key`` is for tests only. Raises
    ReleaseError.
    """
    manifest = _read(folder / MANIFEST)
    check_signature(manifest, _read(folder / SIGNATURE), keys, test_key=test_key)
    try:
        release = msgspec.json.decode(manifest, type=Release)
    except msgspec.DecodeError as error:
        raise ReleaseError(f"{MANIFEST}: {error}") from error
    if release.sequence <= above:
        raise ReleaseError(f"release {release.version} is number {release.sequence}, and number {above} was taken here")
    if _numbers(__version__) < _numbers(release.oldest):
        raise ReleaseError(f"release {release.version} follows {release.oldest} or newer, and this is {__version__}")
    if sys.version_info < _numbers(release.python):
        raise ReleaseError(f"release {release.version} needs Python {release.python}")
    _check_files(folder, release)
    return release


def check_signature(data: bytes, signature: bytes, keys: Iterable[str], *, test_key: bool = False) -> str:
    """Return the trusted comment of a signature that one of ``keys`` made over ``data``. Raises ReleaseError.

    The format: https://jedisct1.github.io/minisign/, signatures of hashes (``ED``) only.
    """
    try:
        untrusted, first, comment, second, end = signature.decode().split("\n")
        signed, comment_signature = _bytes(first), _bytes(second)
    except ValueError as error:
        raise ReleaseError(f"{SIGNATURE} is no signature by minisign") from error
    if not untrusted.startswith(_UNTRUSTED) or not comment.startswith(_TRUSTED) or end or len(signed) != _SIGNED_BYTES:
        raise ReleaseError(f"{SIGNATURE} is no signature by minisign")
    key_id = signed[2:_ID_END]
    key = next((key for key in map(_key, keys) if key[2:_ID_END] == key_id), None)
    if key is None or signed[:2] != b"ED":
        raise ReleaseError(f"{SIGNATURE} is by key {_name(key_id)}, which is none of this robot's")
    if key_id == TEST_ID and not test_key:
        raise ReleaseError(f"{SIGNATURE} is by a test key, with which everybody can sign")
    public = Ed25519PublicKey.from_public_bytes(key[_ID_END:])
    trusted = comment.removeprefix(_TRUSTED)
    try:
        public.verify(signed[_ID_END:], hashlib.blake2b(data).digest())
        public.verify(comment_signature, signed[_ID_END:] + trusted.encode())
    except InvalidSignature:
        raise ReleaseError(f"{MANIFEST} or {SIGNATURE} was changed after key {_name(key_id)} had signed it") from None
    return trusted


def _check_files(folder: Path, release: Release) -> None:
    """Raise ReleaseError unless the folder has exactly the files of the release, unchanged."""
    wheels = [name for name in release.files if _WHEEL.fullmatch(name)]
    if len(wheels) != 1 or set(release.files) != {*wheels, "robot.txt"}:
        raise ReleaseError(f"{MANIFEST} names {', '.join(release.files) or 'no file'}: not a wheel and robot.txt")
    for name, digest in release.files.items():
        if hashlib.sha256(_read(folder / name)).hexdigest() != digest:
            raise ReleaseError(f"{name} is not what {MANIFEST} names: fetch it again")
    if unlisted := {path.name for path in folder.iterdir()} - {MANIFEST, SIGNATURE, *release.files}:
        raise ReleaseError(f"{folder} has more than {MANIFEST} names: {', '.join(sorted(unlisted))}")


def _read(path: Path) -> bytes:
    most = _MOST_BYTES.get(path.name, _MOST_BYTES[""])
    try:
        with open_plain(path) as file:
            data = file.read(most + 1)
    except OSError as error:
        raise ReleaseError(f"{path}: {error.strerror}") from error
    if len(data) > most:
        raise ReleaseError(f"{path} has more than {most} bytes")
    return data


def _bytes(text: str) -> bytes:
    """Return decoded base64, which must be in its one canonical form."""
    data = base64.b64decode(text, validate=True)
    if base64.b64encode(data).decode() != text:
        raise binascii.Error("another form of the same bytes")
    return data


def _key(text: str) -> bytes:
    """Return a public key in minisign's form: its kind, its id, its 32 bytes. Raises ReleaseError."""
    try:
        key = _bytes(text)
    except ValueError:
        key = b""
    if len(key) != _ID_END + 32 or key[:2] != b"Ed":
        raise ReleaseError(f"{text[:60]!r} is no public key of minisign")
    return key


def _name(key_id: bytes) -> str:
    """Return a key's name in minisign's form."""
    return f"{int.from_bytes(key_id, 'little'):016X}"


def _numbers(version: str) -> tuple[int, ...]:
    return tuple(int(number) for number in re.findall(r"\d+", version)[:3])


def main(arguments: Sequence[str]) -> int:
    parser = argparse.ArgumentParser(prog="python -m pebble.update.release", description="Verify a release.")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--trusted", type=Path, required=True, help="folder of the release whose keys count")
    parser.add_argument("--above", type=Path, required=True, help="file with the highest sequence so far")
    options = parser.parse_args(arguments)
    try:
        keys = msgspec.json.decode(_read(options.trusted / MANIFEST), type=Release).keys
        above = int(_read(options.above)) if options.above.exists() else 0
        release = verify(options.folder, keys, above=above)
    except (PebbleError, ValueError) as error:
        sys.stderr.write(f"pebble: refused: {error}\n")
        return 1
    sys.stdout.write(f"{release.version}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
