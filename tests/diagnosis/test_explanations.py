"""The explanations of an ambiguous diagnosis."""

import math

import pytest

from visadapt.diagnosis.explanations import explanations, preferred
from visadapt.diagnosis.result import Cause

DRAG, RUB, SLIDE, PUSH = "quadratic_drag", "viscous_friction", "coulomb_friction", "constant_force"


def cause(effect, *alternatives):
    return Cause(effect, {}, 0.5, math.nan, indistinguishable_from=alternatives)


ONE_OR_TWO = (cause(DRAG, RUB, SLIDE), cause(RUB, DRAG), cause(SLIDE, DRAG))


@pytest.mark.parametrize(
    ("causes", "sets"),
    [
        ((cause(DRAG),), [{DRAG}]),
        ((cause(DRAG, RUB), cause(RUB, DRAG)), [{DRAG}, {RUB}]),
        ((cause(PUSH), cause(DRAG, RUB), cause(RUB, DRAG)), [{PUSH, DRAG}, {PUSH, RUB}]),
        (ONE_OR_TWO, [{DRAG}, {RUB, SLIDE}]),
        (ONE_OR_TWO[1:] + ONE_OR_TWO[:1], [{RUB, SLIDE}, {DRAG}]),
        (
            (cause(DRAG, RUB, SLIDE, PUSH), cause(RUB, DRAG, PUSH), cause(SLIDE, DRAG), cause(PUSH, DRAG, RUB)),
            [{DRAG}, {RUB, SLIDE}, {PUSH, SLIDE}],
        ),
    ],
)
def test_a_cause_is_exchanged_for_what_fits_equally_well(causes, sets):
    assert [{one.effect for one in each} for each in explanations(causes)] == sets


OFFSET, BIAS = "angle_offset", "actuator_bias"


@pytest.mark.parametrize(
    ("of_the_offset", "first"),
    [(0.3, PUSH), (0.6, PUSH), (0.8, OFFSET)],  # of the push and its twin, the bias, half of the rest each
)
def test_sensors_are_believed_unless_a_wrong_one_is_clearly_likelier(of_the_offset, first):
    causes = (cause(OFFSET, PUSH, BIAS), cause(PUSH, OFFSET, BIAS), cause(BIAS, OFFSET, PUSH))
    rest = (1 - of_the_offset) / 2
    ranking = [((OFFSET,), of_the_offset), ((PUSH,), rest), ((BIAS,), rest)]
    sets = [[one.effect for one in each] for each in preferred(causes, ranking)]
    assert sets == [[first], *([name] for name in (OFFSET, PUSH, BIAS) if name != first)]


def test_of_effects_of_sensors_alone_the_likeliest_is_taken():
    causes = (cause(OFFSET, "position_offset"), cause("position_offset", OFFSET))
    assert [one.effect for one in preferred(causes, [])[0]] == [OFFSET]
