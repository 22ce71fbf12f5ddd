"""From steering and throttle to two wheels (paper A.8.3). Pure."""


def clamp(value: float) -> float:
    """``value`` within -1..1."""
    return -1.0 if value < -1.0 else 1.0 if value > 1.0 else value


def mix(x: float, z: float) -> tuple[float, float]:
    """Left and right wheel, -1..1, + = forward, for steering ``x`` (+ = right) and throttle ``z`` (+ = forward)."""
    return clamp(z + x), clamp(z - x)
