"""The connection to operators: heartbeat, forwarding to and from the remote side, media requests, system actions."""
