"""The config section of robots that hear and drive each other on a LAN."""

from typing import Annotated, ClassVar

from pebble.config.transport import ZenohClient
from pebble.config.types import EMPTY, ONE_VALUE, Account, Level, ServiceSection, Topic, doc


class Lan(ZenohClient, frozen=True, kw_only=True):
    """The hub where robots meet. They are its clients: none listens."""

    retired: ClassVar = {"lease_ms": ONE_VALUE, "settings": "the hub is of Zenoh", "listen": "robots meet at a hub"}

    account: Annotated[
        Account, doc("The account of `pebble fleet add … --role neighbour` at a hub with `access`: the name (CN) in "
                     "tls.client_cert.")
    ] = ""  # fmt: skip

    #: A link that stood still for less than this delivers what waited; commands should not be among it.
    lease_ms: ClassVar[int] = 500


class Neighbours(ServiceSection, frozen=True, kw_only=True):
    """Scripts of other robots hear and drive this one, as far as it lets them: docs/neighbours.md."""

    lan: Annotated[Lan, doc("Where the robots meet.")] = Lan()
    shares: Annotated[
        tuple[Topic, ...], doc('What the others may receive: metrics of outgoing/, such as "wheel-odometry".')
    ] = ()
    commanded: Annotated[
        dict[Level, tuple[Topic, ...]],
        doc('By the id of another robot, what its scripts may command: {"goob": ["drive-values"]}.'),
    ] = EMPTY
    listens: Annotated[
        dict[Level, tuple[Topic, ...]],
        doc('By the id of another robot, what this one\'s scripts hear of it: {"fred": ["wheel-odometry"]}.'),
    ] = EMPTY
