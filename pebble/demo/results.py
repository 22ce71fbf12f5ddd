"""What the demo retains of many rounds. Pure."""

from typing import TypeAlias

from pebble.demo.emergency import StopResult
from pebble.demo.following import FollowResult
from pebble.demo.steps import StepResult

Result: TypeAlias = StepResult | StopResult | FollowResult
Key: TypeAlias = tuple[str, str]  # a robot and a step


class Results:
    """The worst round of each robot and step, however long the demo runs.

    What went wrong on an overloaded machine counts only until the step was seen on one that could keep up, or went
    right: ``doubtful`` says of such a step by what the machine was overloaded.
    """

    def __init__(self) -> None:
        self._worst: dict[Key, Result] = {}
        self.doubtful: dict[Key, str] = {}

    def add(self, result: Result, overloaded: str = "") -> None:
        key = (result.robot, result.step)
        doubtful = bool(result.wrong and overloaded)
        if key in self.doubtful and not doubtful:
            del self.doubtful[key]
            self._worst[key] = result
        elif key not in self._worst:
            self._worst[key] = result
            self.doubtful |= {key: overloaded} if doubtful else {}
        elif not doubtful:
            self._worst[key] = max((self._worst[key], result), key=_badness)

    def all(self) -> list[Result]:
        return list(self._worst.values())

    def problems(self) -> list[str]:
        """One line for everything that is wrong."""
        return [
            f"{result.robot}, {result.step}: {wrong}{self._doubt(result)}"
            for result in self._worst.values()
            for wrong in result.wrong
        ]

    def _doubt(self, result: Result) -> str:
        why = self.doubtful.get((result.robot, result.step))
        return "" if why is None else f" (this machine was overloaded and could not keep up: {why})"


def _badness(result: Result) -> tuple[int, float]:
    return len(result.wrong), 0.0 if isinstance(result, FollowResult) else result.stop_s
