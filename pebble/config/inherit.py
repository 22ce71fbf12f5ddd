"""Values that a config file says once for several places: put where they count, before anything is typed."""

from typing import Any

from pebble.config.tree import Services
from pebble.config.types import Service

_SERVICES = tuple(name for name in Services.__struct_fields__ if isinstance(getattr(Services(), name), Service))
_INTERVAL = "retained_publish_interval_seconds"


def inherit(raw: Any) -> Any:
    """``raw`` with the root's log level and the common republish interval in every service, and merged instances."""
    return _with_instances(deep_merge(_shared(raw), raw))


def deep_merge(under: Any, over: Any) -> Any:
    """``over`` laid on ``under``: objects key by key, everything else whole. An empty string or null covers nothing."""
    if over is None or over == "":
        return under
    if not isinstance(under, dict) or not isinstance(over, dict):
        return over
    merged = {key: deep_merge(under.get(key), value) for key, value in over.items()}
    return merged | {key: value for key, value in under.items() if key not in over}  # problems follow the file's order


def _shared(raw: Any) -> dict[str, Any]:
    level = _at(raw, "log_level")
    interval = _at(raw, "services", "defaults", _INTERVAL)
    services = {name: {"log_level": level, _INTERVAL: interval} for name in _SERVICES}
    services["launcher"]["capabilities"] = {"publish_interval_seconds": interval}
    return {"services": services, "web_interface": {"log_level": level}}


def _with_instances(raw: Any) -> Any:
    serial = _at(raw, "services", "serial_mcu_bridge")
    instances = _at(serial, "instances")
    if not isinstance(instances, dict):
        return raw
    shared = {key: value for key, value in serial.items() if key != "instances"}
    merged = {name: deep_merge(shared, own) for name, own in instances.items()}
    return raw | {"services": raw["services"] | {"serial_mcu_bridge": shared | {"instances": merged}}}


def _at(raw: Any, *keys: str) -> Any:
    """The value at a path of keys; None where there is none, as for a key that is not set."""
    for key in keys:
        raw = raw.get(key) if isinstance(raw, dict) else None
    return raw
