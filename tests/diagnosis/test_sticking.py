"""A ball that dry friction stops again and again, seen by a slow camera."""

import pytest

from tests.ball_beam import PERIOD, balanced, to_and_fro
from tests.own_systems import BallBeam
from visadapt.diagnosis import diagnose
from visadapt.effects.catalogue import catalogue
from visadapt.world import World

BY_NAME = {effect.name: effect for effect in catalogue(BallBeam())}
CATALOGUE = [BY_NAME[f"track.{name}"] for name in ("coulomb_friction", "directional_friction")]


def test_the_states_from_which_predictions_start_are_those_of_a_ball_that_stops():
    # Where the ball is taken to roll though it rests, it is soon elsewhere, and tilts the beam.
    friction = BY_NAME["track.coulomb_friction"](force=0.015)
    recording, _ = balanced([friction], 2, 1500, lambda time: to_and_fro(time + 0.714))
    found = diagnose(recording, World(BallBeam(), (), PERIOD), CATALOGUE)
    assert (found.verdict, [cause.effect for cause in found.causes]) == ("identified", ["track.coulomb_friction"])
    assert found.causes[0].parameters["force"].value == pytest.approx(0.015, rel=0.01)
    assert found.gap.after < 1.2 * found.gap.floor


def test_a_beam_that_balances_a_ball_of_another_mass_is_not_held():
    recording, _ = balanced(
        [BY_NAME["ball_mass.scale"](scale=1.5)], 0, 1500, lambda time: 0.2 if 6 < time < 9 else 0.01
    )
    found = diagnose(recording, World(BallBeam(), (), PERIOD), [*CATALOGUE, BY_NAME["ball_mass.scale"]])
    assert not [said for said in found.warnings if "stands still" in said]
    assert found.causes[0].parameters["scale"].value == pytest.approx(1.5, rel=0.01)
