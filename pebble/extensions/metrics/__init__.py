"""An exporter of the robots of a broker as metrics for Prometheus."""

from pebble.extension import Command, Extension

EXTENSION = Extension(
    name="metrics",
    needs=("media", "operator"),
    extra="metrics",
    commands={
        "exporter": Command("pebble.extensions.metrics.command:exporter", "serve metrics to Prometheus", "measure", 60),
    },
    page="docs/ext/metrics.md",
)
