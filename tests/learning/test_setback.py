"""A tuned policy that does much worse on the machine than the one it began as is not kept."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from visadapt.learning.setback import Performance, setback
from visadapt.recordings import Episode
from visadapt.tasks.balance import PAPER_CARTPOLE, Balance
from visadapt.tasks.reach import Reach

WELL = Performance(40, 0, 1.0)


@pytest.mark.parametrize(
    ("later", "why"),
    [
        ([], ""),
        ([WELL] * 4, ""),
        # One episode a round: its cost depends on where it started.
        ([Performance(40, 0, cost) for cost in (0.5, 7.0, 2.0, 0.8)], ""),
        ([Performance(40, 0, 7.0)], ""),
        ([Performance(40, 2, math.nan)], ""),
        ([WELL, WELL, Performance(40, 5, math.nan)], "5 of its episodes on the machine ended early, in 40 steps"),
        ([Performance(40, 0, 30.0)], "on the machine it cost 30 times"),
        ([Performance(40, 0, cost) for cost in (8.0, 5.0, 6.0, 0.5)], "on the machine it cost 5.5 times"),
    ],
)
def test_what_counts_as_much_worse(later, why):
    found = setback([WELL, *later])
    assert found.startswith(why)
    assert bool(found) == bool(why)


def test_a_policy_that_failed_before_cannot_do_much_worse():
    assert setback([Performance(40, 9, math.nan), Performance(40, 10, math.nan)]) == ""


def test_episodes_that_end_early_and_the_cost_of_the_others():
    def still(rows, speed):
        state = np.tile([0.0, speed, 0.0, 0.0], (rows, 1))
        return Episode(0.05 * np.arange(rows), np.zeros((rows, 1)), state)

    task = Balance(PAPER_CARTPOLE)
    # Of 30 steps, in episodes of 20 at most, the last is as long as it could be.
    found = Performance.of([still(13, 1.0), still(14, 1.0), still(6, 1.0)], 20, task)
    assert (found.steps, found.failures) == (30, 2)
    faster = Performance.of([still(13, 2.0), still(14, 2.0), still(6, 2.0)], 20, task)
    assert faster.cost > found.cost > 0
    assert math.isnan(Performance.of([still(6, 1.0)], 20, task).cost)
    assert math.isnan(Performance.of([still(13, 1.0)], 20, None).cost)


def test_of_a_machine_that_keeps_its_task_to_itself_no_cost_is_known():
    """A vehicle whose target shows goals alone: how far it is in its task is not recorded."""
    state = np.tile(np.eye(1, 13, 6), (20, 1))
    flown = Episode(0.05 * np.arange(20), np.zeros((20, 4)), state)
    assert math.isnan(Performance.of([flown], 20, Reach()).cost)
    goals = Reach().training_start(1, 1.0, torch.Generator().manual_seed(0))[1].expand(20, -1).numpy().astype(float)
    assert Performance.of([replace(flown, task_state=goals)], 20, Reach()).cost > 0
