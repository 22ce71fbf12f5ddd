"""The packages that the operator page needs, and some commands, too."""

from importlib.util import find_spec

from pebble.errors import PebbleError

_PACKAGES = ("cryptography", "starlette", "uvicorn", "websockets")  # an extra, which few machines need


def require_packages(what: str = "the operator page") -> None:
    """Raise PebbleError, with the command that installs them, unless they are installed."""
    missing = [name for name in _PACKAGES if find_spec(name) is None]
    if missing:
        raise PebbleError(
            f"{what} needs packages that are not installed ({', '.join(missing)}): pip install 'pebble-robot[web]'"
        )
