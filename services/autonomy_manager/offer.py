"""The list of offered scripts, made again and again because people add and change scripts."""

import logging
import threading
from collections.abc import Callable, Mapping

from pebble.config import Config
from pebble.services.autonomy_manager.catalogue import Catalogue, files
from pebble.services.autonomy_manager.script import Script

log = logging.getLogger(__name__)


class Offer:
    """The offered scripts. ``on_change`` gets `autonomy-files`.

    Only the listing itself runs on another thread than the service's.
    """

    def __init__(
        self,
        config: Config,
        post: Callable[..., None],
        on_change: Callable[[list[dict[str, object]]], None],
        fixed: Mapping[str, Script] | None,
    ) -> None:
        """Store the arguments. ``fixed`` replaces the folders in tests."""
        self.scripts = dict(fixed or {})
        self._fixed = fixed is not None
        self.complete = self._fixed  # the folders were searched at least once; fixed scripts have none
        self._config, self._post, self._on_change = config, post, on_change
        self._files: list[dict[str, object]] | None = None  # as ``on_change`` got it last
        self._wanted, self._ended = threading.Event(), False  # for the thread: list again; end

    def begin(self) -> bool:
        """Begin to list the scripts; return True if :meth:`scan` is to be called now and then, to list them again."""
        if self._fixed:
            self._found(self.scripts)
        else:
            threading.Thread(target=self._scan, name="scripts", daemon=True).start()
        return not self._fixed

    def scan(self) -> None:
        """List the scripts again soon."""
        self._wanted.set()

    def close(self) -> None:
        self._ended = True
        self._wanted.set()

    def _scan(self) -> None:
        """List the scripts on another thread, since running them for their settings takes long."""
        catalogue = Catalogue(self._config)
        while self._wanted.wait() and not self._ended:
            self._wanted.clear()
            try:
                catalogue.scan(lambda scripts: self._post(lambda: self._found(scripts), newest_of="scripts"))
                self._post(self._completed, newest_of="scanned")
            except Exception:  # the thread's boundary: the next scan may succeed
                log.exception("the scripts cannot be listed")

    def _completed(self) -> None:
        self.complete = True

    def _found(self, scripts: Mapping[str, Script]) -> None:
        self.scripts = dict(scripts)
        listed = files(scripts.values())
        if listed != self._files:
            self._files = listed
            self._on_change(listed)
