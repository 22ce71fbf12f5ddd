"""Other gateways at the same broker, by their `online` messages, so that no robot is carried twice. Pure."""

from dataclasses import dataclass

HEARTBEAT_S = 0.5
FRESH_S = 1.25  # so long a heartbeat counts; and so long a gateway listens before it begins
MAX_GATEWAYS = 16  # that are known beside this one


@dataclass(frozen=True, slots=True)
class _Other:
    heard_at: float
    run: str
    robots: frozenset[str]


class OtherGateways:
    """The newest heartbeat of each other gateway.

    ``run`` identifies this gateway: if two carry the same robot, the greater ``run`` continues. Two that begin at the
    same moment both carry it until they hear each other.
    """

    def __init__(self, run: str) -> None:
        self.run = run
        self._others: dict[str, _Other] = {}

    def forget(self) -> None:
        """Forget all gateways, because the connection on which they were heard is lost."""
        self._others.clear()

    def left(self, name: str) -> None:
        """Note that a gateway is gone: it left in order, or its will was published."""
        self._others.pop(name, None)

    def heard(self, name: str, run: str, robots: tuple[str, ...], now: float) -> None:
        """Note a live heartbeat of any gateway."""
        if run == self.run:
            return
        others = self._others.copy()  # another thread may change the table
        if name not in others and len(others) >= MAX_GATEWAYS:
            oldest = min(others, key=lambda other: others[other].heard_at)
            self._others.pop(oldest, None)
        self._others[name] = _Other(now, run, frozenset(robots))

    def carrier(self, robot: str, now: float, *, carried: bool) -> str:
        """Return the other gateway that carries ``robot``; empty if none does. ``carried``: this one carries it too."""
        for name, other in list(self._others.items()):
            is_carrier = now - other.heard_at <= FRESH_S and robot in other.robots
            if is_carrier and (not carried or other.run > self.run):
                return name
        return ""
