"""``pebble topic expand``: takes groups of streams apart beside a broker, for all robots there."""

import time
from typing import Annotated

import typer

from pebble.extensions.operator.client.connection import Target, connected, put_account_into_topics
from pebble.extensions.operator.commands.options import CaCert, PasswordFile
from pebble.extensions.operator.signals import interrupted_by_signals, until_ended


def expand(
    url: Annotated[str, typer.Argument(help="The broker, as mqtt://ops@host.", metavar="URL", show_default=False)],
    password_file: PasswordFile = None,
    ca_cert: CaCert = None,
) -> int:
    """Take groups of streams apart beside a broker, until it is interrupted.

    A robot on a thin link with `group_hz` in its config sends its streams together, while this runs; every program at
    the broker sees the plain topics.

    \b
        pebble topic expand mqtt://127.0.0.1
    """
    from pebble.extensions.thin.expander import ANNOUNCE_S, Expander

    target = Target(url=url, password_file=password_file, ca_cert=ca_cert, program="expand")
    with interrupted_by_signals(), until_ended(), connected(target) as (transport, names):
        expander = Expander(transport)
        put_account_into_topics(transport, names, expander.is_named)
        expander.start()
        while True:
            expander.announce()
            time.sleep(ANNOUNCE_S)
    return 0
