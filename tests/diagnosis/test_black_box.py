"""What the black box says: how far predictions could still improve beside the causes, and the verdict that follows."""

import pytest
import torch

from tests.diagnosed import NOISE, record
from visadapt import diagnose
from visadapt.diagnosis.search import heldout
from visadapt.diagnosis.search.preparation import prepare
from visadapt.diagnosis.search.search import Search
from visadapt.effects import ConstantForce, Parameter, ViscousFriction
from visadapt.effects.forces import CartForce
from visadapt.systems import CartPole
from visadapt.world import World

SOURCE = World(CartPole())
CATALOGUE = [ConstantForce, ViscousFriction]


class Product(CartForce):
    """A force that no sum of functions of one variable each is: it has a mean of zero in each of its factors."""

    table = (Parameter("strength", "N s/m", 0.0, 100.0, 0.0),)

    def push(self, time, state, system):
        return self.value("strength", state) * torch.tanh(10 * state[:, 0]) * state[:, 1]


def rms(recording, effects, black_box=True):
    """Held-out errors half a second ahead, of a set fitted alone, and if asked with the black box beside it."""
    system = SOURCE.system
    with torch.inference_mode():
        rows = prepare(recording, system, effects).rows
        search = Search(system, rows, effects)
        best = search.single(effects[0]) if effects else search.source
        predicted = heldout.held_out(system, rows, [(best.effects, best.fits)], lambda errors: errors)
        if black_box:
            predicted = [*predicted, heldout.beside_black_box(system, rows, best.effects, best.fits)]
        noise = torch.tensor([NOISE[channel] for channel in rows.channels], dtype=torch.float64)
        return [float(heldout.overall(errors.rms(noise))[-1]) for errors in predicted]


def test_a_force_by_the_product_of_two_variables_is_unexplained_and_found_by_the_black_box():
    result = diagnose(record([Product(strength=3.0)], episodes=8), SOURCE, CATALOGUE)
    assert result.verdict == "unexplained"
    gap = result.gap
    assert gap.black_box - gap.floor < 0.4 * (gap.after - gap.floor)


@pytest.mark.parametrize("effects", [[], [ViscousFriction]], ids=["nothing", "friction"])
def test_where_nothing_is_left_the_black_box_predicts_as_the_causes_do(effects):
    alone, beside = rms(record([effect(coefficient=1.5) for effect in effects]), effects)
    assert beside == pytest.approx(alone, rel=0.02)


def test_the_black_box_predicts_where_the_causes_are_missing():
    recording = record([ViscousFriction(coefficient=3.0)], episodes=8)
    (floor,), (without, box) = rms(recording, [ViscousFriction], False), rms(recording, [])
    assert box - floor < 0.2 * (without - floor)
