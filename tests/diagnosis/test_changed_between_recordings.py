"""Recordings between which the machine was changed: each is explained by itself, and it is said with what."""

import dataclasses

import pytest

from tests.diagnosed import record
from visadapt.diagnosis import diagnose
from visadapt.diagnosis.next_experiment import OF_ONE_MACHINE
from visadapt.diagnosis.words import ONE_BY_ONE
from visadapt.effects import AngleOffset, CartMass, ViscousFriction
from visadapt.systems import CartPole
from visadapt.world import World

CATALOGUE = [ViscousFriction, AngleOffset, CartMass]


def of_two_days(*second):
    """Two recordings of two episodes each, of a cart with friction and, in the second, other effects too."""
    days = [record([ViscousFriction(coefficient=2.0), *more], 2, seed=k) for k, more in enumerate(((), second))]
    episodes = tuple(episode for day in days for episode in day.episodes)
    return dataclasses.replace(days[0], episodes=episodes, sources=("monday", "monday", "friday", "friday"))


def test_what_explains_each_is_said():
    found = diagnose(of_two_days(AngleOffset(offset=0.03)), World(CartPole()), CATALOGUE)
    assert (found.verdict, found.next_experiment) == ("unexplained", OF_ONE_MACHINE)
    (said,) = (warning for warning in found.warnings if warning.startswith(ONE_BY_ONE))
    monday, friday = said.removeprefix(f"{ONE_BY_ONE}: ").split("; ")
    assert monday.startswith("monday by viscous friction (coefficient ")
    assert "offset" not in monday
    assert friday.startswith("friday by ")
    offset = friday.partition("angle offset (offset ")[2].split()[0]
    assert float(offset) == pytest.approx(0.03, rel=0.1)
    assert str(found).startswith("unexplained: Each recording is explained by itself, but not all together")
    assert found.where.pushes == ()


def test_the_unchanged_simulator_may_explain_one_of_them():
    days = [record(effects, 2, seed=k) for k, effects in enumerate(((), [ViscousFriction(coefficient=3.0)]))]
    both = dataclasses.replace(
        days[0],
        episodes=tuple(episode for day in days for episode in day.episodes),
        sources=("monday", "monday", "friday", "friday"),
    )
    found = diagnose(both, World(CartPole()), CATALOGUE)
    (said,) = (warning for warning in found.warnings if warning.startswith(ONE_BY_ONE))
    assert said.startswith(f"{ONE_BY_ONE}: monday by the unchanged simulator; friday by viscous friction")


def test_of_a_machine_that_was_left_as_it_is_nothing_is_said():
    found = diagnose(of_two_days(), World(CartPole()), CATALOGUE)
    assert found.verdict == "identified"
    assert not any(warning.startswith(ONE_BY_ONE) for warning in found.warnings)
