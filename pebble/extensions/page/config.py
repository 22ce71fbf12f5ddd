"""The config sections of the operator page: its address, its access, and the robot's service that serves it."""

from collections.abc import Iterator
from typing import Annotated, ClassVar

from pebble.config.hosts import is_loopback
from pebble.config.problems import Path
from pebble.config.reader import Reader, Rule
from pebble.config.rules.exposure import warn_if_readable
from pebble.config.transport import RemoteMqtt
from pebble.config.types import (
    UNIT,
    File,
    Host,
    Level,
    NameOfPage,
    Port,
    Section,
    ServiceSection,
    doc,
)
from pebble.extensions.operator.client.assumed import AXES, Axis

PEOPLE = "people.sqlite"  # the default database, in a state directory


class WebHandler(ServiceSection, frozen=True, kw_only=True):
    """Runs the operator page on the robot; `web_interface` sets it up. It needs `pip install 'pebble-robot[web]'`."""

    retired: ClassVar = {"env": UNIT}


class WebTls(Section, frozen=True, kw_only=True):
    """The certificate that the page shows to browsers; `pebble cert init` makes one."""

    certificate: Annotated[File | None, doc("Certificate of the server; with it the page is https.")] = None
    key: Annotated[File | None, doc("Private key of certificate.")] = None
    ca: Annotated[File | None, doc("Authority of certificate, offered at `/ca.pem` so that phones can trust it.")] = (
        None
    )


class ListedRobot(Section, frozen=True, kw_only=True):
    """A robot that the page knows before the robot publishes anything; boards of the original never do."""

    retired: ClassVar = dict.fromkeys(
        ("model", "video", "audio", "autonomy", "reboot", "service_restart", "git_pull"), "robots say what they have"
    )

    id: Annotated[Level | None, doc("Its id.")] = None
    system: Annotated[Level | None, doc("First level of its topics; unset: that of `robot`.")] = None
    type: Annotated[Level | None, doc("Second level of its topics; unset: that of `robot`.")] = None
    name: Annotated[str | None, doc("What people call it, if it does not say so itself.")] = None
    drive: Annotated[
        bool | None,
        doc(
            "Whether pages drive it although it does not say what it can do; unset: people may allow that on the page."
        ),
    ] = None
    axes: Annotated[tuple[Axis, ...], doc("The axes by which it is driven then.")] = AXES
    plain: Annotated[
        bool, doc('At level named: its account in fleet.json has `"plain": true`, so it takes commands without a name.')
    ] = False


class WebInterface(Section, frozen=True, kw_only=True):
    """The operator page, as served by `pebble web CONFIG` and `services.web_handler`."""

    retired: ClassVar = {
        "robot_discovery": "robots are found by their messages",
        "mqtt_history": "`services.recorder` records into files",
        "log_level": "the one of the file is for all services",
    }

    host: Annotated[
        Host, doc("Address to listen on; one that other machines reach needs tls and a user (`pebble web user add`).")
    ] = "127.0.0.1"
    port: Annotated[Port, doc("TCP port to listen on.")] = 8080
    names: Annotated[tuple[NameOfPage, ...], doc("Further host names and addresses that browsers may use for it.")] = ()
    server: Annotated[Level | None, doc("What it is called on pages and for other servers; unset: this machine.")] = (
        None
    )
    tls: Annotated[WebTls, doc("The page's certificate.")] = WebTls()
    people: Annotated[File | None, doc("Database of users and sessions; unset: in the robot's state directory.")] = None
    plain_http: Annotated[
        bool, doc("Serve other machines without encryption: everybody on the network can read passwords and pictures.")
    ] = False
    plain_http_drive: Annotated[bool, doc("Allow driving from there, too.")] = False
    mqtt: Annotated[
        RemoteMqtt, doc("The broker that robots connect to; without host: services.mqtt_bridge.remote_mqtt.")
    ] = RemoteMqtt()
    robots: Annotated[
        tuple[ListedRobot, ...], doc("Names of robots, and whether boards that do not say what they can do are driven.")
    ] = ()
    recordings: Annotated[
        File | None, doc("Folder of recordings to look at on the page; unset: that of services.recorder, if it runs.")
    ] = None
    expand: Annotated[bool, doc("Take groups of streams apart, as `pebble topic expand` does.")] = False

    @property
    def local(self) -> bool:
        """True if only this machine can reach the page."""
        return is_loopback(self.host)

    def connections(self) -> Iterator[tuple[tuple[str, ...], Section]]:
        if self.mqtt.host:
            yield ("mqtt",), self.mqtt


def _check(reader: Reader, web: WebInterface, path: Path) -> WebInterface:
    """Warn of settings with which the page cannot start. They are no errors: the robot drives without a page."""
    if not web.local and web.tls.certificate is None and not web.plain_http:
        reader.notes.warning(
            (*path, "host"),
            f"other machines reach {web.host}, so the page starts only with a certificate and a user: run "
            f"`pebble cert init` and `pebble web user add`, write web_interface.tls; or leave out host",
        )
    for number, listed in enumerate(web.robots):
        if listed.id is None:
            reader.notes.warning((*path, "robots", number), "has no id, so it is none")
    if not web.mqtt.host and web.mqtt != RemoteMqtt():
        reader.notes.warning((*path, "mqtt"), "not used: it has no host, so the page connects to the robot's broker")
    if web.plain_http and web.tls.certificate is not None:
        reader.notes.warning((*path, "plain_http"), "has no effect: there is a certificate, so the page is https")
    return web


def _check_tls(reader: Reader, tls: WebTls, path: Path) -> WebTls:
    """Refuse a certificate or key without the other. Warn of missing files, and of a key that every user can read."""
    for key, other in (("certificate", "key"), ("key", "certificate")):
        if getattr(tls, key) is not None and getattr(tls, other) is None:
            reader.notes.doubt((*path, other), f"is missing, it belongs to {key}")
    for key in ("certificate", "key", "ca"):
        file = getattr(tls, key)
        if file is not None and not file.is_file():
            reader.notes.warning((*path, key), f"there is no file {file}; run `pebble cert init`")
    if tls.key is not None:
        warn_if_readable(reader.notes, (*path, "key"), tls.key, "this key")
    return tls


RULES: tuple[Rule, ...] = ((WebTls, _check_tls), (WebInterface, _check))
