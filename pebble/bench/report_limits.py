"""What a report's numbers do not show: it has to be said beside them. Pure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from pebble.bench.results import Results

_NO_REAL = (
    "No radio. Every byte went over loopback or a veth pair. Wi-Fi has an air of its own: stations that wait for each "
    "other, retries, rates that change, power save. The profiles of the bad link imitate what that does to bandwidth, "
    "delay and loss, not how it comes about.",
    "No second machine. Both ends of every latency have the same clock, and take turns on the same cores: brokers, "
    "operators and the programs that measure compete with the robot, which on a real robot they do not.",
    "No Raspberry Pi. Its cores are slower, its memory and its USB behave differently, it throttles when hot. Ratios "
    "between variants carry over better than times, and even they only where both are bound by the same thing.",
    "No camera and no microphone. Pictures and sound are synthetic: a moving scene and speech that are the same in "
    "every run. Real ones are noisier, which costs every encoder bytes, and a real device adds a latency of its own.",
    "No hardware encoder. H.264 is x264 on the CPU, as on a robot without one.",
    "No MCU. Its end of the serial line is a simulated board on a pty, which knows no baud rate: at 115,200 baud a "
    "command's line of some 15 bytes takes another 1.3 ms, on each transport alike.",
    "No program in another language. Both ends are Python, with paho and with Zenoh's Python binding; what is measured "
    "includes the interpreter. A C++ node would be faster on either transport, and the ratios would be others.",
    "No big network: no router between hub and peers, no TLS, no other robots on the broker, except in the fleet.",
    "No long run. Each case took seconds to minutes; leaks, and brokers that have been up for a month, are not in it.",
)
_QUICK = (
    "Being quick, it has too few rounds for an interval of 99 % to be narrow, or to mean much; it leaves out most "
    "sizes, rates, loads and trials. “Equal within noise” here mostly says that there was not enough time to see."
)
_NULL = (
    "A null test shows that a comparison does not see what is not there. It does not show that what it sees is due to "
    "the cause one thinks of."
)


def limits(measured: Sequence[Results]) -> list[str]:
    """Sentences, the most important first."""
    return [
        *([_QUICK] if any(one.quick for one in measured) else []),
        _this_machine(measured),
        *_link(measured),
        *_NO_REAL,
        _NULL,
    ]


def _this_machine(measured: Sequence[Results]) -> str:
    machine = measured[0].machine if measured else {}
    cpu, cores = machine.get("cpu") or "some CPU", machine.get("cores") or "a few"
    return (
        f"One machine, {cores} cores of {cpu}, and its mood. Intervals are over rounds of one run, so they hold the "
        "noise of that hour; another run, another kernel or a neighbour on the same host moves medians by more than "
        "they say. Where a machine is virtual, its time can be taken away for milliseconds: the "
        "slowest percent shows it."
    )


def _link(measured: Sequence[Results]) -> list[str]:
    """Not every link loses packets."""
    proxies = [one.options for one in measured if one.bench == "impair" and one.options.get("link") == "proxy"]
    return [
        f"No namespaces: the bad link was a TCP proxy{_because(options)}. A proxy ends TCP on each side, so what is "
        "called loss is a delay as TCP's retransmission would cause it; nothing is lost or resent on any wire."
        for options in proxies
    ]


def _because(options: Mapping[str, object]) -> str:
    why = options.get("why_proxy")
    return f" ({why})" if why else ""
