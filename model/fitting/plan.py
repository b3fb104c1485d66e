# SPDX-License-Identifier: GPL-3.0-or-later
"""How many steps a fit takes. What is asked for in seconds is planned in steps by the speed of a few of them, so that
the schedule (rates, sizes of pictures, densification) is gone through whole, whatever the machine does beside.
"""

from __future__ import annotations

from dataclasses import dataclass

PROBE_SHARE = 0.05  # of the seconds that steps may take by which the speed is measured
# Shares of the seconds after which the plan is corrected, and by what factor at the most: early, as the measure may
# have been wrong; then a little, as scenes grow and shrink under a fit. A stall, or a machine that becomes busy later,
# must not cut the rest off.
CORRECTED = ((0.1, 2.0), (0.25, 2.0), (0.5, 1.25), (0.75, 1.25))
LATE = 1.5  # times the seconds, from which on what is left of the schedule is cut short
LAST = 1.6  # times the seconds, by which it then ends
LEAST_CHANGE = 0.02  # of what is left, for which a plan is corrected


@dataclass(frozen=True)
class Costs:
    """Seconds of a step by the share of the schedule that is done."""

    stages: tuple[tuple[float, float], ...]  # up to which share, and the seconds; in order, the last up to 1

    def at(self, fraction: float) -> float:
        return next((seconds for until, seconds in self.stages if fraction < until), self.stages[-1][1])

    def mean(self, fraction: float) -> float:
        """Of all steps from this share, less than 1, on."""
        total, since = 0.0, fraction
        for until, seconds in self.stages:
            total += max(until - since, 0) * seconds
            since = max(until, since)
        return total / (1 - fraction)

    def times(self, factor: float) -> Costs:
        return Costs(tuple((until, factor * seconds) for until, seconds in self.stages))


class Plan:
    """So many steps, even ones: each is the same share of the schedule."""

    def __init__(self, steps: int):
        self.steps = steps  # in all
        self.even_from = 0, 0.0  # the step, and the share done by then, from which on they are even

    def fraction(self, done: int) -> float:
        """The share 0..1 of the schedule that is gone through after so many steps."""
        if done >= self.steps:
            return 1.0
        step, share = self.even_from
        return share + (1 - share) * (done - step) / (self.steps - step)

    def look(self, elapsed: float, done: int) -> str:
        """To be called before each step; a sentence to be told where the plan does not hold."""
        return ""

    def leave(self, left: int, done: int) -> None:
        """So many more steps, 1 or more, go through what is left of the schedule, from where it stands."""
        self.even_from = done, self.fraction(done)
        self.steps = done + left


class TimedPlan(Plan):
    """As many steps as end after so many seconds. Early on the number is corrected by how long steps really took. What
    is late is finished all the same, but for what would take more than LATE times the seconds."""

    def __init__(self, seconds: float, costs: Costs, elapsed: float = 0.0, most: int | None = None):
        """elapsed: what is spent of the seconds, 0 or more; most: steps that are never exceeded."""
        super().__init__(1)
        self.seconds, self.costs, self.most = seconds, costs, most
        self.corrections = list(CORRECTED)
        self.since, self.expected = elapsed, 0.0  # since the last look at how steps compare with their costs
        self.before, self.told_late = elapsed, False
        self._leave(self._fitting(elapsed, 0), 0)

    def _fitting(self, elapsed: float, done: int) -> float:
        """Steps that the rest of the seconds is enough for."""
        return (self.seconds - elapsed) / max(self.costs.mean(self.fraction(done)), 1e-9)

    def _leave(self, left: float, done: int) -> None:
        left = max(round(left), 1)
        self.leave(min(left, max(self.most - done, 1)) if self.most else left, done)

    def look(self, elapsed: float, done: int) -> str:
        if done >= self.steps:
            return ""
        said, fraction = "", self.fraction(done)
        if self.corrections and elapsed >= self.corrections[0][0] * self.seconds and self.expected > 0:
            _, most = self.corrections[0]
            self.corrections = [c for c in self.corrections if elapsed < c[0] * self.seconds]
            self.costs = self.costs.times((elapsed - self.since) / self.expected)
            self.since, self.expected = elapsed, 0.0
            left, fitting = self.steps - done, self._fitting(elapsed, done)
            if abs(fitting - left) > LEAST_CHANGE * left:
                self._leave(min(max(fitting, left / most), left * most), done)
        elif elapsed > LATE * self.seconds:
            took = max(elapsed - self.before, 1e-9)  # as the machine is now
            left = max(int((LAST * self.seconds - elapsed) / took), 1)
            if left < self.steps - done:
                said = f"slower than planned: the last {self.steps - done:,} steps become {left:,}"
                said, self.told_late = "" if self.told_late else said, True
                self.leave(left, done)
        self.before = elapsed
        self.expected += self.costs.at(fraction)
        return said
