"""The config sections of connections: brokers, Zenoh endpoints, encryption."""

from typing import Annotated, Any, ClassVar, Literal

from msgspec import Meta

from pebble.config.types import (
    EMPTY,
    EXACT,
    ONE_VALUE,
    Account,
    BrokerHost,
    ClientId,
    CommonName,
    Endpoint,
    File,
    Password,
    Port,
    Section,
    Silence,
    doc,
)


class Tls(Section, frozen=True, kw_only=True):
    """Encryption of one connection."""

    retired: ClassVar = {"ciphers": "OpenSSL's own are used, of TLS 1.2 or newer"}
    other_names: ClassVar = {"ca_certs": "ca_cert", "certfile": "client_cert", "keyfile": "client_key"}  # paho's

    enabled: Annotated[bool, doc("Encrypt the connection; otherwise the other keys have no effect.")] = False
    ca_cert: Annotated[File | None, doc("Authority to trust; unset: those of the system.")] = None
    client_cert: Annotated[File | None, doc("Certificate to show; needs client_key.")] = None
    client_key: Annotated[File | None, doc("Private key of client_cert.")] = None
    insecure: Annotated[bool, doc("Do not check that the certificate names the host.")] = False


class Mqtt(Section, frozen=True, kw_only=True):
    """One MQTT broker."""

    retired: ClassVar = {
        "client": "Pebble's own is used; paho is a transport of its own, see docs/transports.md",
        "keepalive": ONE_VALUE,
    }
    refused: ClassVar = {
        "hosts": "is no key any more: write host, a name that has the addresses of all or that of a cluster "
        "(docs/ext/fleet.md, One broker)"
    }

    host: Annotated[BrokerHost, doc("Name or address of the broker.")] = "127.0.0.1"
    port: Annotated[Port, doc("TCP port of the broker.")] = 1883
    username: Annotated[str | None, doc("Login; unset: anonymous.")] = None
    password: Annotated[Password | None, doc("The password itself; better one of the next two.")] = None
    password_file: Annotated[File | None, doc("File that holds the password; a final newline is removed.")] = None
    password_env: Annotated[str | None, doc("Environment variable that holds the password.")] = None
    tls: Annotated[Tls, doc("Encryption.")] = Tls()
    protocol: Annotated[Literal["3.1.1", "5"], doc("Version of MQTT to use.")] = "3.1.1"
    silence_seconds: Annotated[
        Silence, doc("A connection that does not answer for this many seconds is closed and opened again.")
    ] = 2.0


class RemoteMqtt(Mqtt, frozen=True, kw_only=True):
    """A broker that operators connect to."""

    host: Annotated[BrokerHost, doc("Name or address of the broker; required when the bridge is enabled.")] = ""
    client_id: Annotated[
        ClientId | None,
        doc(
            "For a broker that admits only client ids it knows: that of the bridge. Other programs have one that "
            "begins with it. Unset: ids that no other client can guess, and so none can take over."
        ),
    ] = None


class ZenohClient(Section, frozen=True, kw_only=True):
    """Addresses to which a Zenoh session connects, beyond the robot's own processes."""

    connect: Annotated[tuple[Endpoint, ...], doc("Zenoh endpoints to connect to.")] = ()
    tls: Annotated[Tls, doc("Certificates for `tls/` and `quic/` endpoints.")] = Tls()


class ZenohSection(ZenohClient, frozen=True, kw_only=True):
    """Addresses at which a Zenoh session listens, and to which it connects."""

    listen: Annotated[
        tuple[Endpoint, ...],
        doc("Zenoh endpoints to listen on, for other machines; `tls/` and `quic/` need tls.ca_cert."),
    ] = ()
    lease_ms: Annotated[
        # Messages that a silent connection delays for less are delivered: at most 5 s, as types.Silence.
        int, Meta(ge=100, le=5000, description="A Zenoh peer that is silent for this many milliseconds is gone.")
    ] = 2000
    settings: Annotated[dict[str, Any], doc("Settings of a third party's transport.")] = EMPTY


class TransportSection(ZenohSection, frozen=True, kw_only=True):
    """The transport inside the robot."""

    kind: Annotated[str, doc('"mqtt", "zenoh", or the name of a transport that another package offers.')]
    run_dir: Annotated[File | None, doc("Folder of sockets and locks; unset: see above.")] = None
    state_dir: Annotated[File | None, doc("Folder of what survives a power cut; unset: see above.")] = None
    allowed_names: Annotated[
        tuple[CommonName, ...] | None,
        EXACT,
        doc(
            "Names (CN) of the certificates that may connect by `tls/` and `quic/`, or be connected to; "
            "unset: every one that tls.ca_cert signed."
        ),
    ] = None
    access: Annotated[
        File | None,
        EXACT,
        doc("File of `pebble fleet zenoh`: what each of these names may do. It is read again when it changes."),
    ] = None
    journal: Annotated[File | None, doc("File for a Zenoh robot's retained messages; unset: memory only.")] = None
    mqtt_mirror: Annotated[Mqtt | None, doc("Zenoh robots only: offer all topics on this MQTT broker, too.")] = None


class RemoteConnection(ZenohSection, frozen=True, kw_only=True):
    """A connection to operators by another transport than MQTT."""

    kind: Annotated[str, doc('"zenoh", or the name of a transport that another package offers.')]
    account: Annotated[
        Account, doc("The robot's account at a hub with `transport.access`: the name (CN) in tls.client_cert.")
    ] = ""
