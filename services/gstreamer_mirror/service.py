"""Offers pictures and sound where programs written for the original look for them."""

from functools import partial
from typing import Any

from pebble.contract import MEDIA_REPORT
from pebble.errors import DeviceError
from pebble.runtime.service import Service, every
from pebble.services.gstreamer_mirror.forms import Form, Pictures, Sound
from pebble.services.gstreamer_mirror.outlet import Outlet
from pebble.transports.frames import FrameReader


class GstreamerMirror(Service):
    """Each socket has a thread of its own, which reads frames only while a program is connected to it."""

    name = "gstreamer_mirror"
    publishes = (MEDIA_REPORT,)

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        devices = self.config.services.av_daemon
        forms: dict[str, Form] = {"video": Pictures(devices), "audio": Sound(devices)}
        self._outlets = {
            name: Outlet(
                forms[name],
                path,
                partial(self._make_reader, forms[name]),
                partial(self.post, partial(self._on_end, path)),
            )
            for name, path in devices.sockets().items()
        }

    def start(self) -> None:
        for name, outlet in self._outlets.items():
            self.on_stop(partial(self._log_counters, name, outlet))
            outlet.open()
            self.on_stop(outlet.close)

    def _make_reader(self, form: Form) -> FrameReader:
        return FrameReader(self.config.run_dir(), form.stream, views=True, sharing=form.shared, depth=form.depth)

    def _on_end(self, path: object) -> None:
        raise DeviceError(f"the thread that serves {path} has ended")  # the launcher restarts this process

    def _log_counters(self, name: str, outlet: Outlet) -> None:
        self.log.info("%s: lost frames %s", name, outlet.lost)

    @every(1.0)
    def _report(self) -> None:
        now = self.clock()
        for name, outlet in self._outlets.items():
            self.publish(MEDIA_REPORT, outlet.report(now), program=f"{self.name}:{name}")
