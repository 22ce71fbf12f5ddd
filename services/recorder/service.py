"""The service that records the robot on the robot."""

import os
from collections.abc import Iterator
from typing import Any, Final

from pebble.errors import ConfigError
from pebble.extensions.recordings.config import Recorder as RecorderSection
from pebble.extensions.recordings.recorder import metrics
from pebble.extensions.recordings.recorder.recorder import Recorder
from pebble.extensions.recordings.recorder.settings import Options
from pebble.extensions.recordings.recorder.source import Source
from pebble.runtime.connections import REMOTE_RECONNECT_S, local_settings, mqtt_settings
from pebble.runtime.service import Service, every

_NICE: Final = 10  # whatever drives comes first
_METRICS_S: Final = 10.0


class RobotRecorder(Service):
    """A recorder of all messages on the local transport, and on the remote side if the config says so."""

    name = "recorder"

    def start(self) -> None:
        section = self.config.section(RecorderSection)
        options = Options(keep_bytes=section.keep_bytes, keep_media_days=section.keep_media_days, media=section.media)
        folder = section.place
        os.nice(_NICE)
        self._recorder = Recorder(folder, options, {"recorder": self.config.base})
        self._recorder.start()
        self.on_stop(self._recorder.stop)
        self._sources = [
            Source(self._recorder, kind, settings, [f"{self.config.base}/#"], name)
            for name, kind, settings in self._connections()
        ]
        for source in self._sources:
            source.start(timeout=0.0)
            self.on_stop(source.close)
        self.log.info("recording into %s", folder)

    def dropped(self) -> dict[str, int]:
        return {"recording": self._recorder.counters["dropped"]}

    @every(1.0)
    def _check(self) -> None:
        for source in self._sources:
            source.check()

    @every(_METRICS_S)
    def _write_metrics(self) -> None:
        try:
            metrics.write(self._recorder, self._sources)
        except OSError as error:
            self.log.debug("the recorder's numbers cannot be written: %s", error)

    def _connections(self) -> Iterator[tuple[str, str, Any]]:
        """Yield name, kind and settings of each connection."""
        section, bridge = self.config.section(RecorderSection), self.config.services.mqtt_bridge
        yield "", self.config.transport.kind, local_settings(self.config)
        if not section.remote:
            return
        if bridge.remote is not None or not bridge.remote_mqtt.host:
            raise ConfigError("services.recorder.remote: needs services.mqtt_bridge.remote_mqtt.host")
        settings = mqtt_settings(bridge.remote_mqtt, reconnect_max_s=REMOTE_RECONNECT_S, program="recorder")
        yield "remote", "mqtt", settings
