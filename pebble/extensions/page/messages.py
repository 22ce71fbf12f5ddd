"""Messages between a page and the server on the control socket: JSON text, one struct per ``op``.

``ref`` is a component's base topic, ``pebble/robots/goob``; "" is the server itself. Page clocks (``t``) are
milliseconds of ``performance.now()``; server stamps (``now``) are epoch milliseconds. The page's
``messages.d.ts`` is generated from these structs.
"""

from typing import Annotated, Any, Literal, TypeAlias

from msgspec import Meta, Struct

from pebble.contract.identity import LEVEL

MAX_OP_BYTES = 16 * 1024  # of one message of a page

Ref = Annotated[str, Meta(max_length=200)]
Short = Annotated[str, Meta(max_length=64)]
Axis = Annotated[float, Meta(ge=-1, le=1)]
Stamp = Annotated[float, Meta(ge=0, le=1e13)]
Number = Annotated[int, Meta(ge=0, le=1 << 31)]
Share = Annotated[float, Meta(ge=0, le=1)]
Level = Annotated[str, Meta(pattern=LEVEL, max_length=64)]  # one level of a topic


class _FromPage(Struct, frozen=True, kw_only=True, tag_field="op"):
    """A message of a page."""


class Hello(_FromPage, frozen=True, kw_only=True, tag="hello"):
    """The first message. ``token`` is the one of the page's last connection; within 5 s it restores control."""

    version: Short  # of the page; another one than the server's may not drive
    device: Short = ""  # what others see beside the user's name: "phone"
    name: Annotated[str, Meta(max_length=32)] = ""  # of the user, where there is no login; else it is ignored
    token: Short = ""


class Echo(_FromPage, frozen=True, kw_only=True, tag="echo"):
    """The answer to a Ping, at once."""

    n: Number
    t: Stamp


class Watch(_FromPage, frozen=True, kw_only=True, tag="watch"):
    """The component whose page is open; "" is none. Also the metrics that only its page shows are sent then."""

    ref: Ref


class ReadLogs(_FromPage, frozen=True, kw_only=True, tag="read-logs"):
    """Begin or end the log lines of the watched component. The page has those of ``origin`` up to ``after``.

    ``origin``: as in Logs; ``after``: the number of a line.
    """

    ref: Ref
    on: bool
    origin: Short = ""
    after: Number = 0


class Lease(_FromPage, frozen=True, kw_only=True, tag="lease"):
    """Request control (``take``), release it, or withdraw the request. ``over``: even from an active driver."""

    ref: Ref
    take: bool
    over: bool = False


class DriveOp(_FromPage, frozen=True, kw_only=True, tag="drive"):
    """Wanted motion of gesture ``g``, every 50 ms while it lasts, and zeros at its end.

    After a zero by which the driver lets go, a script that was interrupted may resume. ``final``: it must not, because
    the page itself has ended the gesture (focus lost, page hidden …).
    """

    ref: Ref
    g: Number  # of this connection, growing
    t: Stamp
    x: Axis = 0.0
    z: Axis = 0.0
    y: Axis = 0.0
    final: bool = False


class StopOp(_FromPage, frozen=True, kw_only=True, tag="stop"):
    """The space bar: a zero, which every page may send, with or without control. It does not latch."""

    ref: Ref


class EstopOp(_FromPage, frozen=True, kw_only=True, tag="estop"):
    """Emergency stop of one component, or of all (``ref`` ""), repeated by the server until it is confirmed."""

    ref: Ref
    stop: Annotated[str, Meta(pattern="^[0-9a-f]{16}$", max_length=16)]  # new for every press
    why: Annotated[str, Meta(max_length=40)] = ""


class EstopEndOp(_FromPage, frozen=True, kw_only=True, tag="estop-end"):
    """Send this stop no more. Robots that are stopped stay so."""

    stop: Short


class ShownOwner(Struct, frozen=True, kw_only=True):
    """A stopped motor owner as the page showed it."""

    owner: Short
    boot: Short
    count: Number


class EstopResetOp(_FromPage, frozen=True, kw_only=True, tag="estop-reset"):
    """End exactly the stops that the page showed."""

    ref: Ref
    owners: Annotated[tuple[ShownOwner, ...], Meta(max_length=16)]


class PictureFromOp(_FromPage, frozen=True, kw_only=True, tag="picture-from"):
    """Show the picture of ``source`` on the page of ``ref``, for everybody, from now on; "" is that of ``ref``."""

    ref: Ref
    source: Ref


class _Asked(_FromPage, frozen=True, kw_only=True):
    """A request to a robot; it is answered with Done or Refused."""

    n: Number = 0  # of the page, growing; the answer carries it


class LightsOp(_Asked, frozen=True, kw_only=True, tag="lights"):
    """A colour; with ``period`` (seconds) it fades in and out. Black is off."""

    ref: Ref
    r: Share = 0.0
    g: Share = 0.0
    b: Share = 0.0
    period: Annotated[float, Meta(ge=0.05, le=600)] | None = None


class SoundboardOp(_Asked, frozen=True, kw_only=True, tag="soundboard"):
    """Play one of the robot's clips, once or until it is stopped; "" stops."""

    ref: Ref
    file: Annotated[str, Meta(max_length=1000)]
    repeat: bool = False


class AutonomyOp(_Asked, frozen=True, kw_only=True, tag="autonomy"):
    """Start the robot's script ``file`` with the settings ``config``; "" stops the running script."""

    ref: Ref
    file: Annotated[str, Meta(max_length=200)]
    config: Annotated[dict[str, str | float | int | bool | None], Meta(max_length=200)] = {}


class OutletOp(_Asked, frozen=True, kw_only=True, tag="outlet"):
    """Switch one of the component's outlets."""

    ref: Ref
    outlet: Level
    on: bool


class McuOp(_Asked, frozen=True, kw_only=True, tag="mcu"):
    """A command to a self-describing MCU, with the fields of its manifest."""

    ref: Ref
    uid: Level
    name: Level
    value: Annotated[dict[str, bool | int | float], Meta(max_length=64)]


class ActionOp(_Asked, frozen=True, kw_only=True, tag="action"):
    """An action that the robot takes once, and does not acknowledge."""

    ref: Ref
    name: Literal["reboot", "service-restart", "git-pull"]


class BoardOp(_Asked, frozen=True, kw_only=True, tag="board"):
    """Let pages drive a board that does not say what it can do, end that, or clear its retained drive command."""

    ref: Ref
    do: Literal["allow", "withdraw", "clear"]
    extra: bool = False  # it has an axis besides turning and going


class FlagOp(_Asked, frozen=True, kw_only=True, tag="flag"):
    """Set a flag of the robot. The broker retains flags."""

    ref: Ref
    name: Literal["remote-mirror", "mqtt-audio", "mqtt-video"]
    on: bool


class Seek(_FromPage, frozen=True, kw_only=True, tag="seek"):
    """Play on from another time. ``at``: epoch milliseconds."""

    at: Stamp


class Play(_FromPage, frozen=True, kw_only=True, tag="play"):
    """Play, or pause."""

    on: bool


class Speed(_FromPage, frozen=True, kw_only=True, tag="speed"):
    """Play at another speed."""

    speed: Annotated[float, Meta(ge=0.1, le=10)]


#: All that a page can ask for on the socket of a recording.
FromReplay: TypeAlias = Seek | Play | Speed

#: What is published as it is asked for; see robot_commands.py.
RobotOp: TypeAlias = LightsOp | SoundboardOp | AutonomyOp | OutletOp | McuOp | ActionOp | FlagOp

FromPage: TypeAlias = (
    Hello | Echo | Watch | ReadLogs | Lease | DriveOp | StopOp | EstopOp | EstopEndOp | EstopResetOp
    | PictureFromOp | BoardOp | RobotOp
)  # fmt: skip


class _ToPage(Struct, frozen=True, kw_only=True, tag_field="op"):
    """A message of the server."""


class Welcome(_ToPage, frozen=True, kw_only=True, tag="welcome"):
    """The answer to Hello. ``rights``: what the person may do; ``named_rights``: what on robots at level ``named``."""

    server: str
    version: str
    user: str
    role: str
    rights: tuple[str, ...]
    named_rights: tuple[str, ...]
    login: bool  # whether there is anything to log out of
    token: str
    now: float
    recordings: bool = False  # whether this server has some to look at
    drives: bool = True  # False: the page came over plain http from another machine, where driving is switched off
    words: dict[str, str] = {}  # why nothing is driven, for people


class Ping(_ToPage, frozen=True, kw_only=True, tag="ping"):
    """Twice a second. ``round_trip_ms`` is what the newest took; -1: not known yet."""

    n: int
    now: float
    round_trip_ms: float = -1.0


class State(_ToPage, frozen=True, kw_only=True, tag="state"):
    """The newest value of everything that changed: ``[ref, metric, value, age in ms]``; ``gone``: removed components.

    Metrics are those of the contract, with their payload as JSON, and some of the server's own, below ``web/``. Fields
    that cards read are valid, or left out. null: the value was removed.
    """

    now: float
    set: tuple[tuple[str, str, Any, float], ...]
    gone: tuple[str, ...] = ()


class Logs(_ToPage, frozen=True, kw_only=True, tag="logs"):
    """Log lines of the component that the page has open, if the page asked for them. ``first``: the first one's number.

    A missing number belongs to a dropped line. Numbers count within one ``origin``.
    """

    ref: str
    origin: str
    first: int
    lines: tuple[Any, ...]


class Refused(_ToPage, frozen=True, kw_only=True, tag="refused"):
    """The refusal of a request with number ``n``. ``g``: for a drive command, the gesture that is over."""

    cmd: str
    ref: str
    why: str  # for people
    g: int = -1
    n: int = 0


class Done(_ToPage, frozen=True, kw_only=True, tag="done"):
    """A command, the one with ``n``, was handed to the broker. Whether the robot obeys is seen in its own states."""

    cmd: str
    ref: str
    n: int = 0


class Played(_ToPage, frozen=True, kw_only=True, tag="played"):
    """The place in a recording, a few times a second and after each change. Times are epoch milliseconds."""

    at: float
    on: bool  # it is being played
    speed: float
    begins: bool = False  # a seek has arrived: what was sent before is void
    ended: bool = False  # nothing follows
    skipped: tuple[float, float] | None = None  # a time without messages that was left out


class Bye(_ToPage, frozen=True, kw_only=True, tag="bye"):
    """The last message of a connection that the server closes. ``again``: the page may connect again."""

    why: str
    again: bool


class TalkAnswer(Struct, frozen=True, kw_only=True):
    """The state of a page's talk, as text on the sound socket. A talk that is over never goes on."""

    talk: int
    on: bool
    why: str = ""  # it is not, for people


ToPage: TypeAlias = Welcome | Ping | State | Logs | Refused | Done | Bye

ToReplay: TypeAlias = Played | State | Logs | Bye


# -- values of the server's own metrics


class Liveness(Struct, frozen=True, kw_only=True):
    """``web/liveness``: whether the component is there."""

    online: bool | None  # None: not known yet
    silent_s: float | None  # since its last sign of life; None: only retained messages were received
    latency_ms: float | None  # of the newest heartbeat; null: its clock is more than 10 s wrong
    average_latency_ms: float | None  # of those of the last ten
    interval_ms: float | None  # between heartbeats: the mean of the last ten
    whole_seconds: bool  # its clock counts whole seconds: latency says nothing


class OwnerState(Struct, frozen=True, kw_only=True):
    """One motor owner in EstopView."""

    owner: str
    latched: bool
    boot: str
    count: int
    by: str
    why: str
    since: int
    persisted: bool | None
    reset_refused: str | None


class EstopView(Struct, frozen=True, kw_only=True):
    """``web/estop``: the emergency stop of a component, and the progress of a stop that the server sends to it."""

    available: bool  # False: an old robot, or a broker that refuses: it can be stopped, but not held
    latched: bool
    by: str
    why: str
    since: int
    owners: tuple[OwnerState, ...]
    sending: str  # "", "sent", "confirmed", "old", "spared" or "not confirmed"
    sending_text: str
    stop: str  # the name of the stop that is or was sent


class DriverView(Struct, frozen=True, kw_only=True):
    """``web/driver``: who has control; ``by`` is "" while nobody has."""

    by: str = ""
    device: str = ""
    you: bool = False
    idle_s: float | None = None  # since the last gesture ended; None: a gesture lasts, or it is not known
    keeps: bool = False  # the robot keeps control itself: who drives it is asked for it
    asking: bool = False  # this page waits for control
    asks: str = ""  # who asks for it, by the robot
    checked: bool = False  # the broker vouches for the names
    others: bool = False  # commands without control have just moved it, too


class PictureView(Struct, frozen=True, kw_only=True):
    """``web/picture``: the state of a component's pictures on their way to pages."""

    state: str  # "rest", "starting", "flowing", "silent", "held" (it waits while people drive) or "refused"
    why: str
    encoding: str
    per_second: float
    kbits: float
    viewers: int


class SoundView(Struct, frozen=True, kw_only=True):
    """``web/sound``: the state of a component's sound on its way to pages, and who talks to the component."""

    state: str  # "rest", "starting", "flowing", "silent", "held" (it waits while people drive) or "refused"
    why: str
    encoding: str
    listeners: int
    talker: str  # "": there is none


class BrokerView(Struct, frozen=True, kw_only=True):
    """``web/broker`` of ref "": the server's connection to the broker."""

    connected: bool
    problem: str
    #: What the server is not sent although it is connected, and why.
    not_received: str
    robots_omitted: int
    #: Whether a stop was sent to robots that cannot confirm it, because there is no room for more.
    stops_omitted: bool


class PictureFrom(Struct, frozen=True, kw_only=True):
    """``web/picture-from``: the component whose picture this component's page shows; "": this component."""

    source: str


class BoardView(Struct, frozen=True, kw_only=True):
    """``web/board``: a component that sends heartbeats, and does not say what it can do."""

    silent: bool  # False: it says so now
    by: str = ""  # who lets pages drive it; "" nobody does
    refused: str = ""  # why nobody can allow it, or withdraw that
    parked: str = ""  # why it is not driven although that is allowed
    risk: str = ""  # what people have to know who allow it


class FlagsView(Struct, frozen=True, kw_only=True):
    """``web/flags``: the flags of the open component, as the broker retains them; null: it retains none.

    A flag that is removed while the server has no broker keeps its value here.
    """

    remote_mirror: bool | None = None
    mqtt_audio: bool | None = None
    mqtt_video: bool | None = None


SERVER_METRICS: dict[str, type] = {
    "web/liveness": Liveness,
    "web/estop": EstopView,
    "web/driver": DriverView,
    "web/picture": PictureView,
    "web/sound": SoundView,
    "web/picture-from": PictureFrom,
    "web/flags": FlagsView,
    "web/board": BoardView,
    "web/broker": BrokerView,
}
