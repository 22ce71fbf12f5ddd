"""``pebble up`` with options, and its help; ``pebble.cli`` runs a plain ``pebble up CONFIG`` without this module."""

from pebble.commands.options import ConfigArgument


def up(config: ConfigArgument) -> int:
    """Run the robot that CONFIG describes, until Ctrl-C or SIGTERM.

    Starts every enabled service (on Zenoh robots the hub first), and restarts processes that end unexpectedly.

    \b
        pebble up configs/goob.json
    """
    from pebble.config import load
    from pebble.launcher.launcher import Launcher

    return Launcher(load(config)).run()
