"""Recordings within which an effect changes: it is said what, and how large it is from stretch to stretch."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from tests.diagnosed import record
from visadapt.diagnosis import diagnose
from visadapt.diagnosis.next_experiment import AS_IT_CHANGES, OF_ONE_MACHINE
from visadapt.diagnosis.search import changing
from visadapt.diagnosis.search.fitted_models import FittedModels
from visadapt.diagnosis.search.preparation import prepare
from visadapt.diagnosis.search.search import Search
from visadapt.diagnosis.words import CHANGES, CHANGES_BETWEEN
from visadapt.effects import ActuatorGain, CoulombFriction, PoleLength, ViscousFriction
from visadapt.effects.forces import CartForce
from visadapt.recordings import Episode, Recording
from visadapt.systems import CartPole
from visadapt.world import World

CATALOGUE = [ViscousFriction, CoulombFriction, ActuatorGain, PoleLength]


def one_after_the_other(sets) -> Recording:
    """Episodes of one file, each with effects of its own."""
    parts = [record(effects, 1, seed=k) for k, effects in enumerate(sets)]
    episodes = tuple(part.episodes[0] for part in parts)
    return dataclasses.replace(parts[0], episodes=episodes, sources=tuple(f"run.csv, episode {k}" for k in range(6)))


def sizes(warnings, effect):
    (said,) = (warning for warning in warnings if warning.startswith(CHANGES))
    numbers = said.partition(f"{effect} (")[2].partition(")")[0].split(" ", 1)[1]
    return [float(number.split()[0]) for number in numbers.split(", ")]


@pytest.mark.parametrize(
    ("effect", "parameter", "values"),
    [
        (ActuatorGain, "scale", np.linspace(1, 0.7, 6)),
        (ViscousFriction, "coefficient", 1 + 4 * np.exp(-np.arange(6) / 2)),
        (PoleLength, "scale", [1, 1, 1, 1.25, 1.25, 1.25]),
    ],
)
def test_its_size_is_said_from_stretch_to_stretch(effect, parameter, values):
    found = diagnose(
        one_after_the_other([[effect(**{parameter: float(each)})] for each in values]), World(CartPole()), CATALOGUE
    )
    assert (found.verdict, found.next_experiment) == ("unexplained", AS_IT_CHANGES)
    np.testing.assert_allclose(sizes(found.warnings, effect.name.replace("_", " ")), values, rtol=0.1)
    assert [cause.effect for cause in found.partial] == [effect.name]  # what imitates the change is left out
    assert str(found).startswith("unexplained: The size of an effect changes within the recording")


def test_what_changes_within_a_recording_is_no_push():
    # A bearing that sticks from half of a run on, which looks like a push beyond the source.
    generator, period, rows = torch.Generator().manual_seed(0), 0.03, 500
    before, after = (World(CartPole(), [ViscousFriction(coefficient=size).double()], period) for size in (0.0, 4.0))
    gains = torch.tensor([0.3, 0.4, 3.0, 0.6], dtype=torch.float64)
    at, states, actions = before.start(torch.tensor([[0.0, 0.0, 0.05, 0.0]], dtype=torch.float64)), [], []
    with torch.no_grad():
        for row in range(rows):
            aim = 0.15 * np.sin(0.09 * row) + 0.05 * np.sin(0.37 * row)
            action = ((at.state * gains).sum(1, keepdim=True) + aim).clamp(-1, 1)
            states.append(at.state[0])
            actions.append(action[0])
            at = (after if row >= rows // 2 else before).step(at, action)
    clean = torch.stack(states)
    state = (clean + 1e-3 * torch.randn(clean.shape, generator=generator, dtype=torch.float64)).numpy()
    episode = Episode(period * np.arange(rows), torch.stack(actions).numpy(), state)
    measured = tuple(variable.name for variable in CartPole.states)
    found = diagnose(Recording((episode,), measured, period, ("run.csv",)), World(CartPole()), CATALOGUE)
    assert sizes(found.warnings, "viscous friction")[::4] == pytest.approx([0.0, 4.0], abs=0.1)
    assert found.where.pushes == ()
    (said,) = (warning for warning in found.warnings if warning.startswith(CHANGES))
    starts = said.partition("stretches of it, from about ")[2].partition(" s on")[0].split(", ")
    assert float(starts[0]) == 0
    assert len(starts) == len(sizes(found.warnings, "viscous friction"))


class Ridges(CartForce):
    """A force that no effect of the catalogue describes, and that is always the same."""

    equation = "F = 2 sin(60 x)"
    table = ()

    def push(self, time, state, system):
        return 2 * (60 * state[:, 0]).sin()


Ridges.name = "ridges"  # only now, so that it is in no catalogue


class Faint(Ridges):
    """A thirtieth of it."""

    def push(self, time, state, system):
        return super().push(time, state, system) / 30


Faint.name = "faint"


def test_sizes_that_change_from_file_to_file_are_said_for_each():
    """Beside what no effect describes, so that none is explained by itself."""
    cold, warm = ([ViscousFriction(coefficient=size), Faint()] for size in (4.0, 1.5))
    both = dataclasses.replace(one_after_the_other([cold] * 3 + [warm] * 3), sources=("cold",) * 3 + ("warm",) * 3)
    found = diagnose(both, World(CartPole()), CATALOGUE)
    assert (found.verdict, found.next_experiment) == ("unexplained", OF_ONE_MACHINE)
    (said,) = (warning for warning in found.warnings if warning.startswith(CHANGES_BETWEEN))
    assert "cold and warm, in this order" in said
    sizes = said.partition("viscous friction (coefficient ")[2].partition(" N")[0].split(", ")
    np.testing.assert_allclose([float(size) for size in sizes], [4.0, 1.5], rtol=0.1)
    assert str(found).startswith("unexplained: The size of an effect changes from one recording to the next")


def test_of_a_file_that_nothing_explains_nothing_is_said():
    both = one_after_the_other([[ViscousFriction(coefficient=3.0)]] * 3 + [[Ridges()]] * 3)
    found = diagnose(dataclasses.replace(both, sources=("cold",) * 3 + ("warm",) * 3), World(CartPole()), CATALOGUE)
    assert found.verdict == "unexplained"
    assert not any(CHANGES_BETWEEN in warning for warning in found.warnings)


@pytest.mark.parametrize("effects", [(), [ViscousFriction(coefficient=2.0)], [Ridges()]])
def test_of_what_stays_the_same_nothing_is_said(effects):
    found = diagnose(one_after_the_other([effects] * 6), World(CartPole()), CATALOGUE)
    assert not any(warning.startswith(CHANGES) for warning in found.warnings)


def test_sizes_none_of_which_is_likelier_than_nothing_are_not_said(monkeypatch):
    """Of a pole with cogging it was once said that a bias changes: from 0 to 0, six times."""
    monkeypatch.setattr(changing, "MIN_CHANGE", 0.0)
    monkeypatch.setattr(changing, "MAX_LEFT", math.inf)
    rows = prepare(one_after_the_other([()] * 6), CartPole()).rows
    search = Search(CartPole(), rows, [ActuatorGain])
    stretches = [FittedModels(CartPole(), rows.select(torch.tensor([k])), [ActuatorGain]) for k in range(6)]
    assert changing._in_stretches(search, stretches, search.single(ActuatorGain)) is None
