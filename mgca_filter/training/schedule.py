"""Learning rate by step, and when a loss counts as diverging."""

from __future__ import annotations

import math
from dataclasses import dataclass

from .config import ScheduleConfig

MEMORY = 0.98  # of the running average of the loss
SETTLED = 100  # steps after which the average is trusted


def learning_rate(schedule: ScheduleConfig, step: int) -> float:
    """Learning rate of a step: linear warm-up, then a cosine down to a fraction of the peak, or steps.

    The steps are those of OANet and its followers: the rate is multiplied by ``factor`` at each milestone.
    """
    if step < schedule.warmup_steps:
        return schedule.learning_rate * (step + 1) / schedule.warmup_steps
    if schedule.kind == "steps":
        passed = sum(step >= milestone for milestone in schedule.milestones)
        return schedule.learning_rate * float(schedule.factor**passed)
    progress = (step - schedule.warmup_steps) / max(schedule.steps - schedule.warmup_steps, 1)
    cosine = 0.5 * (1.0 + math.cos(math.pi * min(progress, 1.0)))
    return schedule.learning_rate * (schedule.final_fraction + (1.0 - schedule.final_fraction) * cosine)


@dataclass
class LossWatch:
    """Running average of the loss, its lowest value so far, and the number of losses seen."""

    average: float = 0.0
    lowest: float = math.inf
    seen: int = 0

    def diverges(self, loss: float, factor: float) -> bool:
        """Take a step's loss; True where the average has grown to ``factor`` times its lowest value (0 = never)."""
        self.seen += 1
        weight = max(1.0 - MEMORY, 1.0 / self.seen)
        self.average += weight * (loss - self.average)
        if self.seen < SETTLED:
            return False
        self.lowest = min(self.lowest, self.average)
        return factor > 0 and self.average > factor * self.lowest
