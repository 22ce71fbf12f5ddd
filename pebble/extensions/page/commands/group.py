"""``pebble web``: serves the operator page."""

from __future__ import annotations

import getpass
import signal
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import msgspec
import typer
from typer.core import TyperCommand, TyperGroup

from pebble.config import load
from pebble.config.hosts import is_loopback, name_of_page
from pebble.contract.names import NAME
from pebble.errors import PebbleError
from pebble.extensions.fleet.certificates import CA_CERT, SERVER_CERT, SERVER_KEY, own_names
from pebble.extensions.fleet.people import has_user
from pebble.extensions.operator.client.page_packages import require_packages
from pebble.extensions.operator.commands.options import BrokerUrl, CaCert, PasswordFile, host_of
from pebble.extensions.operator.commands.target import broker_of
from pebble.extensions.operator.notices import printing_thread, say
from pebble.extensions.operator.signals import until_ended
from pebble.extensions.page.commands.people import TLS, PeopleOption, default_folder, register_people
from pebble.extensions.page.config import PEOPLE, WebInterface, WebTls
from pebble.runtime.connections import REMOTE_RECONNECT_S
from pebble.runtime.signals import ending_signals
from pebble.transports import MqttSettings

if TYPE_CHECKING:
    from pebble.extensions.page.setting import WebSettings

Host = Annotated[
    str | None,
    typer.Option(help="Address to listen on; 0.0.0.0 is all of this machine. [default: 127.0.0.1]", metavar="HOST"),
]
Port = Annotated[
    int | None, typer.Option(help="TCP port; 0 is a free one. [default: 8080]", metavar="PORT", min=0, max=65535)
]


def serve(
    config: Annotated[
        Path | None,
        typer.Argument(
            help="A robot's config file: its broker, and web_interface.", metavar="CONFIG", show_default=False
        ),
    ] = None,
    url: BrokerUrl = None,
    password_file: PasswordFile = None,
    ca_cert: CaCert = None,
    host: Host = None,
    port: Port = None,
    tls: Annotated[
        Path | None, typer.Option(help="Folder with the certificates of `pebble cert init`.", metavar="FOLDER")
    ] = None,
    name: Annotated[
        list[str] | None,
        typer.Option(help="A further host name by which browsers may address the page; repeatable.", metavar="NAME"),
    ] = None,
    people: PeopleOption = None,
    recordings: Annotated[
        Path | None, typer.Option(help="Folder of `pebble record`, to look at on the page.", metavar="DIR")
    ] = None,
) -> int:
    """Serve the operator page: drive, stop and watch robots in a browser, also on a phone.

    On this machine it needs no login. For others it needs a certificate and a user; without them it does not start,
    and prints the commands that make them.

    \b
        pebble web goob.json
        pebble web --url mqtt://127.0.0.1
        pebble web goob.json --host 0.0.0.0
        pebble web user --help       who may use it
        pebble web audit             who did what
    """
    if (config is None) == (url is None):
        raise PebbleError("which robots is missing: name either a robot's config file or --url mqtt://BROKER")
    require_packages()
    folder = None if tls is None else tls.absolute()
    is_incomplete = folder is not None and not all((folder / file).is_file() for file in (SERVER_CERT, SERVER_KEY))
    usable_folder = None if is_incomplete else folder
    if recordings is not None and not recordings.is_dir():
        raise PebbleError(f"--recordings {recordings}: there is no such folder")
    given = {
        "host": None if host is None else host_of("--host", host),
        "port": port,
        "names": tuple(host_of("--name", text, name_of_page) for text in name or ()),
        "people": people,
        "recordings": recordings,
    }
    options = {key: value for key, value in given.items() if value is not None}
    if url is not None:
        broker = replace(broker_of("--url", url, password_file, ca_cert), reconnect_max_s=REMOTE_RECONNECT_S)
        settings = _settings_of_url(broker, options, usable_folder)
        allows_http = False  # only a config can allow it
    else:
        settings, allows_http = _settings_of_config(Path(str(config)), options, usable_folder)
    needs_certificate = is_incomplete or (settings.certificate is None and not allows_http)
    if missing := _missing(settings, needs_certificate=needs_certificate, is_incomplete=is_incomplete):
        _print_missing(settings, missing, folder or default_folder() / TLS)
        return 2
    return _run(settings)


class _Group(TyperGroup):
    """A group in which ``pebble web CONFIG`` means ``pebble web serve CONFIG``."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        return super().parse_args(ctx, args if args and args[0] in self.commands else ["serve", *args])


class _Serve(TyperCommand):
    """The command ``serve``, whose help shows the command line without ``serve``."""

    def format_usage(self, ctx: Any, formatter: Any) -> None:
        formatter.write_usage(ctx.parent.command_path, " ".join(self.collect_usage_pieces(ctx)))


def register(app: typer.Typer) -> None:
    group = typer.Typer(cls=_Group, help="Serve the operator page.", rich_markup_mode=None)
    group.command("serve", cls=_Serve)(serve)
    register_people(group)
    app.add_typer(group, name="web")


# -- settings


def _settings_of_url(broker: MqttSettings, options: dict[str, Any], folder: Path | None) -> WebSettings:
    """Return the settings of a page without a config; people log in, unless only this machine reaches it, by http."""
    from pebble.extensions.page.setting import WebSettings

    settings = WebSettings(**{"broker": broker, "people": default_folder() / PEOPLE, **options})
    folder = folder or _default_tls_folder(settings.host)
    if folder is not None:
        settings = replace(
            settings, certificate=folder / SERVER_CERT, key=folder / SERVER_KEY, authority=folder / CA_CERT
        )
    return replace(settings, login=settings.certificate is not None or not is_loopback(settings.host))


def _settings_of_config(file: Path, options: dict[str, Any], folder: Path | None) -> tuple[WebSettings, bool]:
    """Return the settings, and whether the config allows plain http."""
    from pebble.extensions.page.run import settings_or_all_problems

    config = load(file)
    web = config.section(WebInterface)
    web = msgspec.structs.replace(web, **{**options, "names": (*web.names, *options["names"])})
    if folder is None and web.tls.certificate is None and not web.plain_http:
        folder = _default_tls_folder(web.host)
    if folder is not None:
        tls = WebTls(certificate=folder / SERVER_CERT, key=folder / SERVER_KEY, ca=folder / CA_CERT)
        web = msgspec.structs.replace(web, tls=tls)
    # A missing certificate is no error yet: the caller reports it, with the commands that make one.
    lenient = msgspec.structs.replace(web, plain_http=True)
    settings = settings_or_all_problems(msgspec.structs.replace(config, web_interface=lenient))
    # `pebble web user add ann` does not know the config: its people count until the robot's own page has some.
    shared = default_folder() / PEOPLE
    if settings.login and web.people is None and not has_user(settings.people) and has_user(shared):
        settings = replace(settings, people=shared)
    return settings, web.plain_http


def _default_tls_folder(host: str) -> Path | None:
    folder = default_folder() / TLS
    return folder if not is_loopback(host) and (folder / SERVER_CERT).is_file() else None


def _missing(settings: WebSettings, *, needs_certificate: bool, is_incomplete: bool) -> list[str]:
    """Return which of "certificate" and "user" are needed and missing.

    A page that only this machine reaches needs neither, unless --tls names a folder that ``is_incomplete``: it lacks
    the certificate or its key.
    """
    if not settings.login and not is_incomplete:
        return []
    missing = ["certificate"] if needs_certificate else []
    if not has_user(settings.people):
        missing.append("user")
    return missing


def _print_missing(settings: WebSettings, missing: list[str], folder: Path) -> None:
    reason = "a page with --tls has a login"
    if not is_loopback(settings.host):
        reason = f"other machines reach {settings.host}"
    lines = [f"pebble: {reason}, so the page needs a {' and a '.join(missing)}:"]
    if "certificate" in missing:
        lines.append(f"    pebble cert init --folder {folder} {' '.join(own_names())}")
    if "user" in missing:
        lines.append(f"    pebble web user add {_me()} --role admin --people {settings.people}")
    again = f"    pebble {' '.join(sys.argv[1:])}"
    if "certificate" in missing and "--tls" not in again:
        again += f" --tls {folder}"
    typer.echo("\n".join([*lines, again]), err=True)


def _me() -> str:
    """Return this machine's user, or "alice" if the page allows no such name."""
    try:
        user = getpass.getuser().lower()
    except (KeyError, OSError):
        user = ""
    return user if NAME.fullmatch(user) else "alice"


def _run(settings: WebSettings) -> int:
    from pebble.extensions.page.serve import run

    hangups = [number for number in ending_signals() if number.name == "SIGHUP"]  # none on Windows or under nohup
    for number in hangups:  # the terminal was closed: end as with Ctrl-C, which stops what pages move
        signal.signal(number, lambda *_: signal.raise_signal(signal.SIGINT))
    # Uvicorn raises SIGTERM again once it has ended in order. A terminal that stands still holds up no stop of a page.
    with until_ended(), printing_thread() as printing:
        run(replace(settings, say=say), on_ready=lambda url: printing.run(partial(_print_ready, settings, url)))
    return 0


def _print_ready(settings: WebSettings, url: str) -> None:
    typer.echo(f"The operator page is at {url} (Ctrl-C ends it)")
    if settings.login:
        typer.echo(f"Who may log in is in {settings.people}")
    if settings.authority is not None and settings.authority.is_file():
        show = f"pebble cert show --folder {settings.authority.parent}"
        typer.echo(f"Browsers must trust {url}ca.pem once; `{show}` explains how")
    elif settings.login and settings.certificate is None:
        typer.echo("pebble: it is not encrypted: everybody on the network can read passwords and pictures", err=True)
