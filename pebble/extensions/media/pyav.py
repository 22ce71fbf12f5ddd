"""PyAV, for H.264 and Opus. It is imported only where it is used, because that costs some 20 MB and 100 ms."""

from importlib.util import find_spec
from typing import Any, Final

from pebble.contract.encodings import NEED_PYAV
from pebble.errors import PebbleError

INSTALL: Final = "needs PyAV: pip install 'pebble-robot[media]'"


def installed() -> bool:
    """True if PyAV is installed. Does not import it."""
    try:
        return find_spec("av") is not None
    except ValueError:  # sys.modules["av"] is None, which forbids the import
        return False


def available(encodings: tuple[str, ...]) -> tuple[str, ...]:
    """Return the ``encodings`` that this installation can make."""
    return tuple(name for name in encodings if name not in NEED_PYAV or installed())


def load(codec: str) -> Any:
    """Return the module ``av``. Raises PebbleError if it is not installed."""
    try:
        import av
        import av.error
        import av.video.frame
    except ImportError as error:
        raise PebbleError(f"{codec} {INSTALL} ({error})") from None
    return av
