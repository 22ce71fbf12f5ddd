"""The owner of camera and microphone: captures while there are readers, for any number of them."""

from pebble.extension import Extension, Program, Stage

EXTENSION = Extension(
    name="av_daemon",
    needs=("media",),
    extra="media",
    sections={"services.av_daemon": "pebble.services.av_daemon.config:AvDaemon"},
    rules="pebble.services.av_daemon.config:RULES",
    program=Program(
        "av_daemon",
        "pebble.services.av_daemon.service:AvDaemon",
        stage=Stage.DEVICE,
        preloaded=False,
        shares=("pebble.extensions.media.frames",),
        has_sockets=True,
    ),
    offers="pebble.services.av_daemon.offers:offers",
    facts="pebble.services.av_daemon.offers:facts",
    page="docs/ext/media.md",
)
