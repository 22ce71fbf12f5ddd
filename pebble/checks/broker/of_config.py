"""Checks of the brokers that a config names."""

from collections.abc import Iterator
from functools import partial

from pebble.checks.broker.account import page_account, robot_account
from pebble.checks.broker.login import broker
from pebble.checks.broker.login_attempt import TIMEOUT_S, attempt
from pebble.checks.broker.reachable import beyond_loopback, own_addresses
from pebble.checks.check import CheckResult, State
from pebble.config import Config
from pebble.config.rules import exposure
from pebble.config.web import is_loopback
from pebble.contract.levels import LEVELS
from pebble.runtime.connections import REMOTE_RECONNECT_S, mqtt_settings

#: By the config section of each broker that the robot uses.
_NAMES = {"local_mqtt": "local broker", "mqtt_mirror": "mirror's broker", "remote_mqtt": "remote broker"}


def brokers(config: Config) -> Iterator[CheckResult]:
    """Check each broker that the robot uses: its login, its account, and where else it answers."""
    level, link = config.security.level, config.services.mqtt_bridge.link
    sections = {str(path[-1]): mqtt for path, mqtt in exposure.brokers(config)}
    for section, name in _NAMES.items():
        if (mqtt := sections.get(section)) is None:
            continue
        is_remote = section == "remote_mqtt"
        answer_s = LEVELS[link.slowest if is_remote else "wide"].answer_s
        patient = partial(attempt, timeout_s=max(TIMEOUT_S, answer_s))
        settings = mqtt_settings(mqtt, reconnect_max_s=REMOTE_RECONNECT_S, program="doctor")
        results = list(broker(name, settings, patient, level=level))
        yield from results
        if is_remote and results[0].state is State.OK:
            yield from robot_account(results[0].what, settings, config.base, answer_s, level)
        if is_loopback(settings.host):
            yield from beyond_loopback(name, settings, own_addresses())


def page_brokers(config: Config) -> Iterator[CheckResult]:
    """Check that the broker of an operator page that has its own lets it in, and delivers what all robots send."""
    mqtt, level = config.web_interface.mqtt, config.security.level
    if not mqtt.host:
        return
    settings = mqtt_settings(mqtt, reconnect_max_s=REMOTE_RECONNECT_S)
    results = list(broker("page's broker", settings, level=level))
    yield from results
    if not any(result.state is State.FAILED for result in results):
        yield from page_account(results[0].what, settings, level)
