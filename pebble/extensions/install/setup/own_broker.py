"""The robot's own broker: this machine's mosquitto, with a folder that `pebble fleet` can change later."""

from pathlib import Path

from pebble.extensions.fleet import applying, broker_files, certificates, folder
from pebble.extensions.fleet.folder import CONF, PID, Fleet, Server
from pebble.extensions.fleet.roles import Account, ProgramRole
from pebble.extensions.install.setup.answers import PAGE
from pebble.extensions.operator.places import Places
from pebble.runtime.as_owner import as_owner

LINKS = {CONF: "../conf.d/pebble.conf", PID: "../../../run/mosquitto/mosquitto.pid"}


def fleet_of(account: str, base: str, people: Path) -> Fleet:
    """Return a fleet with accounts for the robot and its page. Its broker requires a login; other machines need TLS."""
    accounts = {
        account: Account(roles=(ProgramRole.ROBOT,), bases=(base,)),
        PAGE: Account(roles=(ProgramRole.PAGE,), people=str(people)),
    }
    host = certificates.own_names()[0]
    return Fleet(level="login", brokers=(Server(host=host, included=True),), accounts=accounts)


def conf_text(places: Places, fleet: Fleet) -> bytes:
    """Return the configuration that mosquitto includes. Its paths are as programs on the robot name them."""
    return broker_files.conf_text(fleet, Path(places.named(places.broker_folder)), "").encode()


def make(new: Path, fleet: Fleet, passwords: dict[str, str]) -> None:
    """Fill a new folder with the broker's files."""
    applying.make(new, fleet, passwords)
    with folder.locked(new):
        pass  # its file belongs to the folder
    link(new)


def link(place: Path) -> None:
    """Make links in ``place`` to mosquitto's configuration and pid file; relative, so valid below another root."""
    for name, target in LINKS.items():
        if not (place / name).is_symlink():
            (place / name).symlink_to(target)


def knows(place: Path, wanted: Fleet, passwords: dict[str, str]) -> bool:
    """True if the broker's files have these accounts, with their rules and these passwords."""
    with as_owner(place):
        fleet = folder.load(place)
        stored = applying.passwords_of(place)
    accounts_agree = all(fleet.accounts.get(name) == account for name, account in wanted.accounts.items())
    return accounts_agree and all(
        name in stored and stored[name].is_of(password) for name, password in passwords.items()
    )


def change(place: Path, wanted: Fleet, passwords: dict[str, str]) -> None:
    """Add these accounts to the broker, which reads them at once if it runs."""
    with as_owner(place), folder.locked(place):
        fleet = folder.load(place)
        for name, account in wanted.accounts.items():
            fleet = fleet.without(name).with_account(name, account)
        applying.apply(place, fleet, passwords)
