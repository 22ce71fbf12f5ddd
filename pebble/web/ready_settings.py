"""The settings of an operator page that people can use: where a login is needed, there is a user."""

from pebble.client.page.from_config import has_login, people_of, settings_of
from pebble.client.page.settings import WebSettings
from pebble.config import Config
from pebble.errors import ConfigError, PebbleError
from pebble.fleet.people import People


def ready_settings_of(config: Config) -> WebSettings:
    """The settings of a page that people can use. Raises ConfigError with everything that is missing."""
    settings = settings_or_all_problems(config)
    if problems := _without_user(config):
        raise ConfigError(problems)
    return settings


def settings_or_all_problems(config: Config) -> WebSettings:
    """The settings of the page; the error also says whether a user is missing: it is not found only after the rest."""
    try:
        return settings_of(config)
    except ConfigError as error:
        try:
            more = _without_user(config)
        except PebbleError as other:
            more = [str(other)]
        raise ConfigError([*error.problems, *more]) from None


def _without_user(config: Config) -> list[str]:
    """The problem that a login is needed and there is no user; empty if all is well."""
    if not has_login(config.web_interface):
        return []
    people = People(people_of(config))
    try:
        if people.list():
            return []
    finally:
        people.close()
    return [
        f"web_interface.people: {people_of(config)} has no user: run "
        f"`pebble web user add NAME --people {people_of(config)}` as the user who runs the robot"
    ]
