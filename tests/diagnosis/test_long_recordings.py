"""A long recording counts as a whole: every row sharpens what is said, and the time it takes is said before."""

import re
from dataclasses import replace

import pytest
import torch

from tests.diagnosed import record
from visadapt import diagnose
from visadapt.diagnosis.search.fitted_models import FittedModels
from visadapt.diagnosis.search.preparation import prepare
from visadapt.effects import ConstantForce, PeriodicForce, ViscousFriction
from visadapt.estimation.fit_states import CAREFUL, with_effect
from visadapt.systems import CartPole
from visadapt.world import World

SOURCE = World(CartPole())
CATALOGUE = [ConstantForce, ViscousFriction]
COEFFICIENT = 0.8  # N s/m


def diagnosed(episodes):
    """The diagnosis of episodes of 60 rows with viscous friction, and the lines announced."""
    said: list[str] = []
    recording = record([ViscousFriction(coefficient=COEFFICIENT)], episodes=episodes)
    return diagnose(recording, SOURCE, CATALOGUE, announce=said.append), said


@pytest.fixture(scope="module")
def short():
    return diagnosed(10)


@pytest.fixture(scope="module")
def long():
    return diagnosed(80)


def width(result):
    low, high = result.causes[0].parameters["coefficient"].ci90
    return high - low


def test_every_row_of_a_long_recording_narrows_the_interval(short, long):
    # Eight times the rows: 0.35 of the width; the rows that are searched alone would give 0.71.
    assert width(long[0]) < 0.45 * width(short[0])


def test_a_long_recording_is_diagnosed_as_a_short_one(short, long):
    for result, _ in (short, long):
        assert result.verdict == "identified"
        assert [cause.effect for cause in result.causes] == ["viscous_friction"]
        assert result.causes[0].parameters["coefficient"].value == pytest.approx(COEFFICIENT, rel=0.03)
        assert result.gap.closed == pytest.approx(1.0, abs=0.05)
        assert result.warnings == ()
    assert long[0].recording.samples == 80 * 59  # executed commands


def test_what_there_is_to_do_is_said_before_it_begins(short, long):
    (line,) = long[1]
    assert re.fullmatch(r"4,800 rows of 2 channels, 2 effects: about \d+ s on 1 core, up to \d+ (s|min) where .*", line)
    assert short[1][0].startswith("600 rows of 2 channels")


def test_the_phases_of_episodes_that_were_not_searched_are_found_too():
    phases = torch.linspace(-3.0, 3.0, 24)[torch.randperm(24, generator=torch.Generator().manual_seed(0))]
    running = PeriodicForce(amplitude=1.5, frequency=0.6, phase=phases, offset=0.0)
    recording = record([running], episodes=24, measured=("x", "x_dot", "theta", "theta_dot"))
    result = diagnose(recording, SOURCE, [PeriodicForce, ViscousFriction, ConstantForce])
    assert result.verdict == "identified"
    assert [cause.effect for cause in result.causes] == ["periodic_force"]
    assert result.causes[0].parameters["amplitude"].value == pytest.approx(1.5, rel=0.03)
    assert result.gap.closed == pytest.approx(1.0, abs=0.05)


def test_the_fit_of_the_best_set_to_all_rows_is_not_given_up_on_its_way():
    """From the states of a source that is far off it falls behind: a steady wind was then a periodic one."""
    rows = prepare(record([ViscousFriction(coefficient=COEFFICIENT)]), CartPole()).rows
    models = FittedModels(CartPole(), rows, CATALOGUE, rival=1e6)
    start = [((ViscousFriction,), with_effect(models.source.fits, [9.0]))]
    models.fitted[frozenset()] = replace(
        models.source, fits=replace(models.source.fits, likelihood=torch.tensor([1e6]))
    )
    (given_up,) = models.fit(start, CAREFUL)
    assert float(given_up.fits.theta) != pytest.approx(COEFFICIENT, rel=0.1)
    (found,) = models.fit(start, CAREFUL, to_the_end=True)
    assert float(found.fits.theta) == pytest.approx(COEFFICIENT, rel=0.1)
