"""Predictions half a second ahead, from the states that a fitted set's smoother estimates."""

import pytest
import torch

from tests.diagnosed import record
from visadapt import diagnose
from visadapt.diagnosis.search.heldout import rollout_errors
from visadapt.diagnosis.search.model_comparison import compare
from visadapt.diagnosis.search.preparation import prepare
from visadapt.diagnosis.search.search import Search
from visadapt.effects import ConstantForce, CoulombFriction
from visadapt.estimation.candidate import CandidateModel
from visadapt.systems import CartPole
from visadapt.world import World

STICKING = CoulombFriction(force=2.0)


@pytest.fixture(scope="module")
def search():
    """Of the right set alone, on positions with much noise."""
    rows = prepare(record([STICKING], 6, seed=3, noise=(0.005, 0.0, 0.009, 0.0)), CartPole()).rows
    search = Search(CartPole(), rows, [CoulombFriction])
    search.single(CoulombFriction)
    return search


def test_a_right_set_predicts_within_the_noise_also_where_the_cart_sticks(search):
    """With the little process noise that its fit has, the states from which it starts are 1.4 % off."""
    comparison = compare(search)
    assert comparison.best.names == ("coulomb_friction",)
    deviation = (comparison.predicting.log_noise[0] / 2).exp()
    errors = rollout_errors(CandidateModel(CartPole(), [CoulombFriction], search.rows), comparison.predicting, 10)
    torch.testing.assert_close(errors.rms(deviation)[-1], errors.floor(deviation)[-1], rtol=0.002, atol=0)


@pytest.mark.parametrize(("rows", "first_is_used"), [(11, True), (12, False), (60, False)])
def test_a_window_starts_no_prediction_with_its_first_state_unless_it_has_no_other(rows, first_is_used):
    cut = prepare(record([STICKING], 4, rows), CartPole()).rows
    errors = rollout_errors(CandidateModel(CartPole(), [], cut), Search(CartPole(), cut, []).source.fits, 10)
    starts = errors.valid[-1].sum((0, 2)) > 0
    assert bool(starts[0]) == first_is_used
    assert starts[:2].any() == (rows < 60)  # of 10 rows, where there are others, none starts in the first two
    assert starts.any()


def test_a_gap_shows_in_episodes_that_are_shorter_than_half_a_second():
    recording = record([ConstantForce(force=6.0)], 12, rows=9)
    found = diagnose(recording, World(CartPole()), [ConstantForce])
    assert found.verdict == "identified"
    assert "predictions 0.4 s ahead" in found.gap.measure
    assert found.gap.closed > 0.9
