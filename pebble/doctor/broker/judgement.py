"""A broker is judged: it is reached, tried, and left as it was; and what that means for robots."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager

from pebble.check_result import State
from pebble.doctor.broker.peer import Bench, RefusedError
from pebble.errors import TransportError
from pebble.transports.hosts import addresses_of, described
from pebble.transports.settings import MqttSettings

_RETAINED = ("retained messages", "retained, to + and #")


@contextmanager
def reached(settings: MqttSettings, below: str, restart: Callable[[], bool] | None = None) -> Iterator[Bench]:
    """Connect; at the end everything is removed. Raises TransportError."""
    bench = _bench(settings, below, restart)
    try:
        yield bench
    finally:
        bench.close()


def _bench(settings: MqttSettings, below: str, restart: Callable[[], bool] | None) -> Bench:
    where = f"broker {settings.host}:{settings.port}"
    try:
        addresses = addresses_of(settings.host, settings.port)
    except (OSError, UnicodeError) as error:
        raise TransportError(f"{where}: {getattr(error, 'strerror', None) or error}") from None
    failures = {}
    for address in addresses:
        bench = Bench(settings, address, below, restart)
        try:
            bench.peer()
        except RefusedError as error:
            failures[f"{address.text}:"] = str(error)
        else:
            return bench
    raise TransportError(f"{where} cannot be used: {described(failures)}")


def assessment(found: Mapping[str, State]) -> list[str]:
    """What robots, operators and a mirror have of a broker, by the findings of the probes."""
    broken = [name for name, level in found.items() if level is State.FAILED]
    if broken:
        return [f"robots cannot use it with this account: {', '.join(broken)}"]
    limits = [name for name, level in found.items() if level is State.WARN]
    idle = all(found.get(name) is State.OK for name in _RETAINED)
    named = found.get(_RETAINED[0]) is State.OK
    unless = "only by asking for their exact names, as ours do" if named else "not at all"
    return [
        f"robots can use it{', with limits: ' + ', '.join(limits) if limits else ''}",
        f"operators see robots at rest {'by + and #, and by name' if idle else unless}",
        f"a mirror {'can' if found.get('bridge mode') is State.OK else 'cannot'} use it",
    ]
