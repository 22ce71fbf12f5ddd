"""The names of a robot's channels (paper A.4.1). Pure."""


def base(system: str, kind: str, name: str) -> bytes:
    """What all its topics begin with; behind it come /incoming/{metric} and /outgoing/{metric}."""
    for part in (system, kind, name):
        for char in part or "/":
            if char in '/+#"\\' or char < " ":
                raise ValueError("not a name for a topic: " + repr(part))
    return b"%s/%s/%s" % (system.encode(), kind.encode(), name.encode())
