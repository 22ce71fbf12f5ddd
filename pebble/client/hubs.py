"""What hubs tell of themselves."""

import zenoh

from pebble.transports.settings import ZenohSettings
from pebble.transports.zenoh import wire
from pebble.transports.zenoh.hub.mesh import HubState, decode_state
from pebble.transports.zenoh.session import HUB_SOCKET, close_session, open_session, session_config

ANSWER_S = 2.0


def hub_states(settings: ZenohSettings) -> list[HubState]:
    """The state of the hub of ``settings.run_dir`` and of those linked to it, by name; empty if it does not run."""
    config = session_config(
        ZenohSettings(run_dir=settings.run_dir), "client", listen=[], connect=[settings.run_dir / HUB_SOCKET]
    )
    try:
        session = open_session(config)
    except zenoh.ZError:
        return []
    try:
        states = [decode_state(answer) for answer in wire.ask(session, f"{wire.STATE}*", b"", ANSWER_S)]
    finally:
        close_session(session)
    # After a hub hung, queries of one other may reach it twice for a while (measured; no message does).
    return sorted({one.name: one for one in states}.values(), key=lambda one: one.name)
