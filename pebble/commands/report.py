"""``pebble doctor --report``: packs what helps to find a fault, without a secret."""

from pathlib import Path

import typer

from pebble.setup.places import Places


def report(file: Path, config: Path | None, root: Path) -> int:
    """Write the zip file; without a config it is about the installed robot."""
    from pebble.selftest.new_file import write_new  # of Linux only
    from pebble.selftest.report import make

    if file.exists():
        raise typer.BadParameter(f"{file} exists: name another file, or remove it")
    if config is not None and not config.exists():
        raise typer.BadParameter(f"{config} does not exist: name a robot's config file")
    made = make(Places(root.absolute()), None if config is None else config.absolute())
    write_new(file, made.packed())
    typer.echo(f"{file}: {', '.join(made.parts)}")
    for name, why in made.missing.items():
        typer.echo(f"missing: {name}: {why}")
    if made.unread:
        typer.echo(f"pebble: warning: passwords in {len(made.unread)} files were not searched for: use sudo", err=True)
    return 0
