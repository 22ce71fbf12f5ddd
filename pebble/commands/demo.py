"""``pebble demo``: four simulated robots, on Zenoh, on MQTT and on MCUs, driven through one broker."""

from __future__ import annotations

from typing import Annotated

import typer


def demo(
    seconds: Annotated[
        float | None,
        typer.Option("--seconds", "-s", min=1, help="Stop after this long of driving.", show_default=False),
    ] = None,
) -> int:
    """Four simulated robots, driven by a scripted operator who cannot tell which is which.

    Goob on Zenoh, Fred on MQTT, MiniLAMP and BenJr on MCUs with their own firmware, without hardware, until Ctrl-C.
    With --seconds it exits 0 only if every robot moved and stopped as commanded.

    \b
        pebble demo
        pebble demo --seconds 20
    """
    from pebble.demo.main import run

    return run(seconds)


def register(app: typer.Typer) -> None:
    app.command("demo")(demo)
