"""Finds differences between a fleet's table and its files, and certificates that expire soon; a line each."""

from collections.abc import Iterator
from pathlib import Path

from pebble.extensions.fleet import certificates
from pebble.extensions.fleet.applying import conf_differences, passwords_of, zenoh_differences
from pebble.extensions.fleet.broker_files import acl_text, rules_in
from pebble.extensions.fleet.folder import ACL, Fleet, FleetError
from pebble.ownership import read_plain

_SOON_DAYS = 30


def by_hand(folder: Path, fleet: Fleet) -> list[str]:
    """Return the differences that no command removes, each with what to do. Raises FleetError."""
    return [*conf_differences(folder, fleet), *_certificates(folder, fleet)]


def of_rules(folder: Path, fleet: Fleet) -> list[str]:
    """Return the differences of accounts and rules, which `pebble fleet apply` removes. Raises FleetError."""
    return [*zenoh_differences(folder, fleet), *_of_acl(folder, fleet), *_of_passwords(folder, fleet)]


def _certificates(folder: Path, fleet: Fleet) -> Iterator[str]:
    renewals = {folder / certificates.SERVER_CERT: f"`pebble cert renew --folder {folder}`, then restart mosquitto"}
    for name in fleet.accounts:
        file = folder / certificates.ACCOUNTS / f"{name}.pem"
        if file.exists():
            renewals[file] = f"`pebble fleet certificate {name}`, with its hosts, and move it to its machine"
    for file, how in renewals.items():
        days = certificates.show(file).days_left
        if days < _SOON_DAYS:
            yield f"{file} ends in {days:.0f} days: {how}"


def _of_acl(folder: Path, fleet: Fleet) -> Iterator[str]:
    try:
        present_rules = dict.fromkeys(rules_in(read_plain(folder / ACL).decode()))
    except OSError as error:
        raise FleetError(f"{error.filename}: {error.strerror}") from None
    wanted = dict.fromkeys(rules_in(acl_text(fleet)))
    yield from (f"one rule too many: {rule}" for rule in present_rules if rule not in wanted)
    yield from (f"one rule too few: {rule}" for rule in wanted if rule not in present_rules)


def _of_passwords(folder: Path, fleet: Fleet) -> Iterator[str]:
    stored = passwords_of(folder)
    yield from (f"{name}: an account too many: the broker lets it in" for name in stored.keys() - fleet.accounts)
    yield from (f"{name}: has no password: `pebble fleet password {name}`" for name in fleet.accounts - stored.keys())
