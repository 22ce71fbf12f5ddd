"""The connection settings of the backends: plain data, so that reading a config imports no client library."""

from dataclasses import dataclass, field
from pathlib import Path


@dataclass(frozen=True, slots=True, kw_only=True)
class TlsSettings:
    """The certificates of one connection; all paths are absolute."""

    ca_cert: Path | None = None  # None: the system's authorities
    client_cert: Path | None = None
    client_key: Path | None = None
    insecure: bool = False  # True: do not check the host name


@dataclass(frozen=True, slots=True, kw_only=True)
class MqttSettings:
    """One broker connection."""

    host: str
    port: int = 1883
    keepalive_s: int = 15
    username: str | None = None
    password: str | None = field(default=None, repr=False)
    password_file: Path | None = None  # where the password was read, and is read again when it has changed
    tls: TlsSettings | None = None
    #: For brokers that admit only ids they know. None: one that cannot be guessed, which no other client can take over.
    client_id: str | None = None
    protocol: str = "3.1.1"  # or "5"
    #: Request exact ``echo=False`` and the retain flag of live messages from the broker (bridge mode on 3.1.1,
    #: noLocal and retain-as-published on 5). See T7 and T16 in docs/transports.md.
    as_published: bool = False
    reconnect_max_s: float = 0.5  # 0.5 inside the robot, 2.0 towards a remote broker
    silence_s: float = 2.0  # a connection that does not answer for this long is replaced (T19)
    #: For programs that only listen. The highest QoS to subscribe with: a broker sends any number of retained messages
    #: at 0, and at 1 no more than it queues (mosquitto: 1,000). And whether it is to send them at all (MQTT 5).
    max_qos: int = 1
    sends_retained: bool = True
    #: Filters of topics that are sent even to a broker that hangs up on them.
    vital: tuple[str, ...] = ()
    #: Bytes of one TCP segment, in both directions; 0: as many as the way seems to take. Some ways lose large ones.
    max_segment: int = 0
    dscp: int = 0  # of our packets (RFC 2474), where the system permits it: 46 is served before 10


@dataclass(frozen=True, slots=True, kw_only=True)
class ZenohSettings:
    """One peer of a robot's Zenoh network; ``run_dir`` contains the unix sockets of the hub and of all peers."""

    run_dir: Path
    listen: tuple[str, ...] = ()  # extra endpoints beyond the unix socket; never a default
    connect: tuple[str, ...] = ()
    tls: TlsSettings | None = None
    allowed_names: tuple[str, ...] | None = None  # of certificates on tls/ and quic/; None: all that ca_cert signed
    lease_ms: int = 2000
    client: bool = False  # a short-lived tool: connects to the hub only, opens no socket of its own
    journal: Path | None = None  # where the hub stores retained messages and wills; only the hub reads it
    of_robot: bool = False  # a robot's hub runs without an endpoint whose port is taken
    #: Whether the hub takes a will, by filters of its topic: the last one that matches decides; without one it does.
    wills: tuple[tuple[str, bool], ...] = ()
    unretained: tuple[str, ...] = ()  # filters of topics on which the hub retains nothing
    access: Path | None = None  # of a hub: what each name of a certificate may do, from `pebble fleet zenoh`
    max_wills: int | None = None  # that the hub stores; None: 1,000
    account: str = ""  # of a client: the name in its certificate, under which a hub with ``access`` knows it
