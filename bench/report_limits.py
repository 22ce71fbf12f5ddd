"""The limits of a report's numbers, which belong beside them. Pure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from pebble.bench.results import Results

_NO_REAL = (
    "No radio. Every byte went over loopback or a veth pair. Wi-Fi has contention between stations, retries, changing "
    "rates and power save. The profiles of the impaired network imitate the effect of these on bandwidth, delay and "
    "loss, not their cause.",
    "No second machine. Both ends of every latency use the same clock and share the same cores: brokers, operators and "
    "the measuring programs compete with the robot, which they do not on a real robot.",
    "No Raspberry Pi. Its cores are slower, its memory and USB behave differently, and it throttles when hot. Ratios "
    "between variants transfer better than times, and only where both are limited by the same resource.",
    "No camera and no microphone. Pictures and sound are synthetic: a moving scene and speech that are the same in "
    "every run. Real ones are noisier, which costs every encoder bytes, and a real device adds latency.",
    "No hardware encoder. H.264 is x264 on the CPU, as on a robot without one.",
    "No MCU. Its end of the serial line is a simulated board on a pty, which has no baud rate: at 115,200 baud a "
    "command's line of about 15 bytes takes another 1.3 ms, on each transport alike.",
    "No other language. Both ends are Python, with paho and with Zenoh's Python binding; the results include the "
    "interpreter. A C++ node would be faster on either transport, with other ratios.",
    "No large network: no router between hub and peers, no TLS, no other robots on the broker, except in the fleet.",
    "No long run. Each case took seconds to minutes; leaks, and brokers that have run for a month, are not covered.",
)
_QUICK = (
    "A quick run has too few rounds for a narrow 99 % interval, and leaves out most sizes, rates, loads and trials. "
    "“Equal within noise” here mostly means that there was not enough time to measure a difference."
)
_NULL = (
    "A null test shows that a comparison finds no difference where there is none. It does not show the cause of the "
    "differences that it finds."
)


def limits(measured: Sequence[Results]) -> list[str]:
    """The limits as sentences, the most important first."""
    return [
        *([_QUICK] if any(one.quick for one in measured) else []),
        _this_machine(measured),
        *_proxy_limits(measured),
        *_NO_REAL,
        _NULL,
    ]


def _this_machine(measured: Sequence[Results]) -> str:
    machine = measured[0].machine if measured else {}
    cpu, cores = machine.get("cpu") or "an unknown CPU", machine.get("cores") or "some"
    return (
        f"One machine, {cores} cores of {cpu}. Intervals are over the rounds of one run, so they include the noise of "
        "that hour; another run, another kernel or another load on the same host changes medians by more than they "
        "show. On a virtual machine the host can take CPU time away for milliseconds: the slowest percent shows it."
    )


def _proxy_limits(measured: Sequence[Results]) -> list[str]:
    """How the impaired network was made, if by a proxy."""
    proxies = [one.options for one in measured if one.bench == "impair" and one.options.get("link") == "proxy"]
    return [
        f"No namespaces: the impaired network was a TCP proxy{_proxy_reason(options)}. A proxy ends TCP on each side, "
        "so loss is modelled as the delay of TCP's retransmission; no packet is lost or resent on any wire."
        for options in proxies
    ]


def _proxy_reason(options: Mapping[str, object]) -> str:
    why = options.get("why_proxy")
    return f" ({why})" if why else ""
