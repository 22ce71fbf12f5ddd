"""The file of ``pebble fleet hub``: a Zenoh hub for several robots, on a machine of its own."""

import os
from pathlib import Path
from typing import Annotated

from msgspec import Meta

from pebble.config.config import default_run_folder
from pebble.config.raw import decode, plain, read_text
from pebble.config.reader import Reader
from pebble.config.rules.between_keys import CHECKS
from pebble.config.transport import ZenohSection
from pebble.config.types import CommonName, File, doc
from pebble.errors import ConfigError
from pebble.runtime.connections import tls_settings
from pebble.transports import ZenohSettings


class HubFile(ZenohSection, frozen=True, kw_only=True):
    """A hub: the addresses where it listens, and the Zenoh routers that it connects to."""

    run_dir: Annotated[File | None, doc("Folder of its socket and lock; unset: one of its own.")] = None
    journal: Annotated[File | None, doc("File for what it retains; unset: memory only.")] = None
    access: Annotated[
        File | None, doc("File of `pebble fleet zenoh`: what each name of a certificate may do there.")
    ] = None
    allowed_names: Annotated[
        tuple[CommonName, ...] | None, doc("Without access: names (CN) of the certificates that may connect.")
    ] = None
    max_wills: Annotated[
        int, Meta(ge=1, le=1_000_000, description="Clients that may leave a will: a robot has one or two.")
    ] = 1000


def load_hub(path: Path) -> ZenohSettings:
    """Read the file; return the settings of its hub. Raises ConfigError with all problems."""
    path = path.absolute()
    raw = decode(read_text(path), path.name)
    reader = Reader(path.parent, os.environ, CHECKS, file=path)
    hub = reader.section(HubFile, plain(raw, reader.notes))
    if not hub.listen:
        reader.notes.problem(("listen",), 'is missing: a hub is reached there, such as ["tls/0.0.0.0:7447"]')
    if reader.notes.problems:
        raise ConfigError(list(dict.fromkeys(f"{path.name}: {problem}" for problem in reader.notes.problems)))
    return ZenohSettings(
        run_dir=hub.run_dir or default_run_folder(f"hub {path}", os.environ),
        listen=hub.listen,
        connect=hub.connect,
        tls=tls_settings(hub.tls),
        allowed_names=hub.allowed_names,
        access=hub.access,
        lease_ms=hub.lease_ms,
        journal=hub.journal,
        max_wills=hub.max_wills,
    )
