"""The config sections about where messages go: brokers, Zenoh endpoints, encryption."""

from typing import Annotated, Any, Literal

from msgspec import Meta, field

from pebble.config.types import Endpoint, File, Interval, Password, Port, Section, doc


class Tls(Section, frozen=True, kw_only=True):
    """Encryption of one link."""

    enabled: Annotated[bool, doc("Encrypt the link; without it the other keys do nothing.")] = False
    ca_cert: Annotated[File | None, doc("Authority to trust; unset: those of the system.")] = None
    client_cert: Annotated[File | None, doc("Certificate to show; needs client_key.")] = None
    client_key: Annotated[File | None, doc("Private key of client_cert.")] = None
    insecure: Annotated[bool, doc("Do not check that the certificate names the host.")] = False
    ciphers: Annotated[str | None, doc("OpenSSL cipher list; unset: OpenSSL's own.")] = None


class Mqtt(Section, frozen=True, kw_only=True):
    """One MQTT broker."""

    host: Annotated[str, doc("Name or address of the broker.")] = "127.0.0.1"
    port: Annotated[Port, doc("TCP port of the broker.")] = 1883
    keepalive: Annotated[
        int, Meta(ge=0, le=65535, description="Seconds between signs of life on an idle connection; 0: none.")
    ] = 15
    username: Annotated[str | None, doc("Login; unset: anonymous.")] = None
    password: Annotated[Password | None, doc("The password itself; better one of the next two.")] = None
    password_file: Annotated[File | None, doc("File that holds the password; a final newline is left out.")] = None
    password_env: Annotated[str | None, doc("Environment variable that holds the password.")] = None
    tls: Annotated[Tls, doc("Encryption.")] = Tls()
    protocol: Annotated[Literal["3.1.1", "5"], doc("Version of MQTT to speak.")] = "3.1.1"
    silence_seconds: Annotated[
        Interval, doc("A connection that does not answer for this many seconds is closed and opened anew.")
    ] = 2.0


class RemoteMqtt(Mqtt, frozen=True, kw_only=True):
    """The broker where operators are."""

    host: Annotated[str, doc("Name or address of the broker; required when the bridge is enabled.")] = ""


class ZenohLink(Section, frozen=True, kw_only=True):
    """Where a Zenoh session listens and connects, beyond what it does by itself."""

    listen: Annotated[tuple[Endpoint, ...], doc("Zenoh endpoints to listen on, for machines elsewhere.")] = ()
    connect: Annotated[tuple[Endpoint, ...], doc("Zenoh endpoints to connect to.")] = ()
    tls: Annotated[Tls, doc("Certificates for `tls/` and `quic/` endpoints.")] = Tls()
    lease_ms: Annotated[
        int, Meta(ge=100, le=600_000, description="A Zenoh peer that is silent for this many milliseconds is gone.")
    ] = 2000
    settings: Annotated[dict[str, Any], doc("Anything a third party's transport wants to know.")] = field(
        default_factory=dict
    )


class TransportSection(ZenohLink, frozen=True, kw_only=True):
    """How messages move inside the robot."""

    kind: Annotated[str, doc('"mqtt", "zenoh", or the name of a transport that another package offers.')]
    run_dir: Annotated[File | None, doc("Folder of sockets and locks; unset: as told above.")] = None
    journal: Annotated[File | None, doc("File in which a Zenoh robot keeps its kept state; unset: memory only.")] = None
    mqtt_mirror: Annotated[Mqtt | None, doc("Zenoh robots only: offer the robot's topics on this MQTT broker too.")] = (
        None
    )


class RemoteLink(ZenohLink, frozen=True, kw_only=True):
    """A way to operators other than MQTT."""

    kind: Annotated[str, doc('"zenoh", or the name of a transport that another package offers.')]
