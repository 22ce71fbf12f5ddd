"""The figures of robots' traffic: bandwidth, sessions, heartbeats, outages, latency (paper, section 4.1).

Definitions, all of payload bytes and of the time of receiving, without retained messages:

* An *active second* of a family is a second with at least one message of it; medians and percentiles (linear
  interpolation) are over its active seconds, as in Table 4.1.
* A *session* is a time in which a robot was used, with breaks of at most 120 s, and 5 s more at both ends. *Idle* is
  the time without a session in which heartbeats came.
* An *outage* is a heartbeat interval of more than 1.5 times the robot's median; its length is the interval minus the
  median. Intervals above 60 s count as offline. What the recorder did not see is neither.
"""

from typing import Final

from msgspec import Struct, field

#: Families of messages. The paper's Figure 4.3 and Table 4.1 have their bandwidths.
VIDEO, AUDIO, VOICE, DRIVING, CONTROL, HEARTBEATS, TELEMETRY, TOTAL = FAMILIES = (
    "video", "audio", "voice", "drive", "control", "heartbeat", "telemetry", "total",
)  # fmt: skip
ALL, SESSION, IDLE = TIMES = ("all", "session", "idle")
LINUX, MCU, COMPONENT = "Linux", "MCU", "component"

SESSION_GAP_S, SESSION_MARGIN_S = 120, 5
OUTAGE_FACTOR: Final = 1.5
OFFLINE_AFTER_S: Final = 60
LARGEST_LATENCY_S: Final = 86_400  # stamps further away are of clocks that do not count from 1970


class Bandwidth(Struct, frozen=True):
    """The kbit/s of a family of messages, in its active seconds."""

    family: str
    time: str  # one of TIMES
    seconds: int  # active ones
    median_kbps: float
    p95_kbps: float
    messages: int
    bytes: int


class Session(Struct, frozen=True):
    """A time in which a robot was used; seconds since 1970."""

    since_s: int
    until_s: int


class Outage(Struct, frozen=True):
    """A time in which heartbeats were missing."""

    since_ns: int  # the last heartbeat before it
    length_ms: float  # by which the interval was longer than usual


class Histogram(Struct, frozen=True):
    """Counts of equal bins.

    ``counts[i]`` counts values from ``low + i * width`` on; the first and last bin also those beyond.
    """

    low: float
    width: float
    counts: list[int]


class Latency(Struct, frozen=True):
    """The times from heartbeats' stamps to their arrival, by the two clocks."""

    count: int
    median_ms: float
    p95_ms: float
    histogram: Histogram


class RobotTraffic(Struct, kw_only=True):
    """The results for one robot or another component."""

    robot: str  # system/type/id
    machine: str  # LINUX, MCU, or COMPONENT without heartbeats
    messages: int
    bytes: int
    bandwidth: list[Bandwidth]
    sessions: list[Session]
    interval_ms: float | None  # the median between heartbeats, without those above OFFLINE_AFTER_S
    outages: list[Outage]
    latency: Latency | None

    def of(self, family: str, time: str = ALL) -> Bandwidth | None:
        return next((row for row in self.bandwidth if row.family == family and row.time == time), None)


class Gap(Struct, frozen=True):
    """A time in which nothing was recorded."""

    since_ns: int
    until_ns: int
    why: str


class Traffic(Struct, kw_only=True):
    """The result of an analysis."""

    since_ns: int  # of the first message
    until_ns: int  # of the last one
    recordings: int
    missing: int  # messages that damage of recordings has taken
    unread: list[str] = field(default_factory=list)  # a line for each recording that could not be read completely
    dropped: int  # messages that the recorder could not write
    gaps: list[Gap]
    robots: list[RobotTraffic]
