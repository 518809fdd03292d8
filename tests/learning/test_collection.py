"""The samples of a round outlast an interruption, and a target that fails."""

import numpy as np
import pytest
import torch

import visadapt as va
from visadapt.learning.collection import Kept, collect
from visadapt.learning.setback import Performance

POLICY = va.load_policy(va.shipped("cartpole_states"))
WANTED, LONGEST = 50, 20


class Counting(va.SyntheticTarget):
    """Counts the steps that are taken, and raises `error` in place of one of them, once."""

    taken, failing = 0, -1
    error: BaseException = OSError("no answer from the motor")

    def step(self, action):
        if self.taken == self.failing:
            self.failing = -1
            raise self.error
        self.taken += 1
        return super().step(action)


def of(target, folder):
    generator = torch.Generator().manual_seed(0)
    return collect(POLICY, target, WANTED, LONGEST, generator, kept=Kept(folder))


def test_what_a_target_showed_before_it_failed_is_data_too(tmp_path):
    target = Counting()
    target.failing = 27
    with pytest.raises(OSError, match="no answer"):
        of(target, tmp_path / "kept")
    assert Kept(tmp_path / "kept").cut() == [1]
    episodes = of(target, tmp_path / "kept")
    assert Performance.of(episodes, LONGEST, None, cut=[1]).failures == 0
    assert [episode.samples for episode in episodes] == [20, 7, 20, 3]
    assert target.taken == WANTED
    assert all((episode.action[-1] == 0).all() for episode in episodes)


def test_an_interrupted_collection_ends_as_one_that_was_not(tmp_path):
    target = Counting()
    target.failing, target.error = 27, KeyboardInterrupt()
    with pytest.raises(KeyboardInterrupt):
        of(target, tmp_path / "kept")
    resumed, whole = of(target, tmp_path / "kept"), of(va.SyntheticTarget(), tmp_path / "another")
    for one, other in zip(resumed, whole, strict=True):
        np.testing.assert_array_equal(one.state, other.state)
        np.testing.assert_array_equal(one.action, other.action)
