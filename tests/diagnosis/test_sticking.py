"""A ball that dry friction stops again and again, seen by a slow camera."""

import pytest

from experiments.ball_beam import PERIOD, BallBeam, balanced, to_and_fro
from visadapt.diagnosis import diagnose
from visadapt.diagnosis.search.preparation import prepare
from visadapt.diagnosis.search.search import Search
from visadapt.effects.catalogue import catalogue
from visadapt.world import World

BY_NAME = {effect.name: effect for effect in catalogue(BallBeam())}
CATALOGUE = [BY_NAME[f"track.{name}"] for name in ("coulomb_friction", "directional_friction")]


def test_a_fit_from_states_at_which_the_ball_rests_is_likelier():
    friction = BY_NAME["track.coulomb_friction"]
    recording, _ = balanced([friction(force=0.015)], 4, 900, lambda time: to_and_fro(time + 3.6))
    search = Search(BallBeam(), prepare(recording, BallBeam(), [friction]).rows, [friction])
    before = search.single(friction)
    search.fit_at_rest(before)
    assert float(search.single(friction).fits.likelihood[0] - before.fits.likelihood[0]) > 5


def test_a_beam_that_balances_a_ball_of_another_mass_is_not_held():
    recording, _ = balanced(
        [BY_NAME["ball_mass.scale"](scale=1.5)], 0, 1500, lambda time: 0.2 if 6 < time < 9 else 0.01
    )
    found = diagnose(recording, World(BallBeam(), (), PERIOD), [*CATALOGUE, BY_NAME["ball_mass.scale"]])
    assert not [said for said in found.warnings if "stands still" in said]
    assert found.causes[0].parameters["scale"].value == pytest.approx(1.5, rel=0.01)
