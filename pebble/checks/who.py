"""Who can drive a robot now: in words, and by name where the folder of its fleet is at hand."""

from collections.abc import Iterator
from pathlib import Path

from pebble.checks.check import CheckResult, ok, some_of, warn
from pebble.config import Config
from pebble.config.rules.doors import warning_of_open
from pebble.fleet.folder import FLEET, Fleet, FleetError, load
from pebble.fleet.roles import ProgramRole, Right, rights

_WHO = "who can drive"
_SHOWN = 12  # names in one line
_WORDS = {
    "open": "every program that reaches its broker, which here only this machine's do",
    "login": "every account of its broker with a role that drives; which one sent a command is not checked",
    "named": "every account of its broker with a role that drives, under its own name",
}


def who_drives(config: Config) -> Iterator[CheckResult]:
    """Tell its level, and who may drive it at that."""
    level = config.security.level
    if open_ := warning_of_open(config):
        yield warn(open_, "pebble fleet init, then the account of this robot")
        return
    yield ok(f"level {level}: it is driven by {_WORDS[level]}")
    for folder in _folders(config) if level != "open" else ():
        try:
            yield ok(_accounts(load(folder)), what=_WHO)
        except FleetError as error:
            yield warn(str(error), what=_WHO)
    if level == "named" and config.security.unnamed != "refuse":
        while_ = " while nobody has control" if config.security.unnamed == "free" else ""
        yield warn(
            f'also senders without a name{while_}, because security.strangers is "{config.security.unnamed}"',
            "leave out security.strangers once all clients have names",
            _WHO,
        )


def _accounts(fleet: Fleet) -> str:
    """Return those whose roles let them drive, servers of the page with a word more."""
    names = [
        f"{name} (a page server: its people, too)" if ProgramRole.PAGE in account.roles else name
        for name, account in fleet.accounts.items()
        if Right.DRIVE in rights(account.roles, fleet.level)
    ]
    return f"{some_of(names, _SHOWN) or 'no account'}; programs on the robot itself, too"


def _folders(config: Config) -> list[Path]:
    """Return where the files of its fleet are: beside its config, or the authority that it trusts."""
    ca_cert = config.services.mqtt_bridge.remote_mqtt.tls.ca_cert
    places = [config.folder, *([] if ca_cert is None else [Path(ca_cert).parent])]
    return [folder for folder in (place.absolute() for place in places) if (folder / FLEET).is_file()][:1]
