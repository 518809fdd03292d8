import pytest

from tests.effects.registry import LIBRARY
from visadapt.effects import EFFECTS, ActuatorBias, ActuatorDelay, ConstantForce, Dropout, Payload, ViscousFriction
from visadapt.effects.catalogue import catalogue, catalogue_markdown, catalogue_text, twins
from visadapt.systems import SYSTEMS, CartPole, Quadrotor

NAMED = sorted(LIBRARY.keys() - {"residual"})


def test_a_system_has_the_effects_that_act_on_it():
    assert set(NAMED) <= {effect.name for effect in catalogue()}
    for kind in SYSTEMS.values():
        own = catalogue(kind())
        assert {ConstantForce, ActuatorDelay, Dropout} <= set(own)
        assert (ViscousFriction in own, Payload in own) == (kind is CartPole, kind is Quadrotor)


def test_twins_are_those_of_a_system():
    assert twins(ActuatorBias, catalogue(), CartPole()) == [ConstantForce]
    assert twins(ConstantForce, catalogue(), CartPole()) == [ActuatorBias]
    assert twins(ActuatorBias, catalogue(), Quadrotor()) == twins(ConstantForce, catalogue(), Quadrotor()) == []


@pytest.mark.parametrize(
    ("default", "large", "changed"),
    [
        (CartPole(), CartPole(cart_mass=10.9), {"N": 10.0, "N m": 1.0}),
        (CartPole(), CartPole(pole_mass=0.3, pole_half_length=0.5), {"N": 1.3 / 1.1, "N m": 3.0}),
        (CartPole(), CartPole(cart_mass=0.2), {"N": 1.0, "N m": 1.0}),
        (Quadrotor(), Quadrotor(mass=3.0), {"N": 3.0, "N m": 3.0}),
    ],
)
def test_forces_and_torques_are_searched_in_ranges_that_grow_with_the_system_s_weight(default, large, changed):
    for effect, grown in zip(catalogue(default), catalogue(large), strict=True):
        assert (grown.name, grown.stage, issubclass(grown, effect)) == (effect.name, effect.stage, True)
        assert EFFECTS[effect.name] is effect
        for before, after in zip(effect.table, grown.table, strict=True):
            scale = changed["N m" if before.unit.startswith("N m") else "N"] if before.unit.startswith("N") else 1.0
            assert after.low == pytest.approx(scale * before.low)
            assert after.high == pytest.approx(scale * before.high)


@pytest.mark.parametrize("name", NAMED)
def test_every_effect_is_on_the_pages_with_all_that_it_states(name):
    effect = EFFECTS[name]
    (paragraph,) = (p for p in catalogue_text().split("\n\n") if p.startswith(f"{name} ("))
    (section,) = (s for s in catalogue_markdown().split("### ") if s.startswith(f"{name}\n"))
    for page in (paragraph, section):
        assert effect.equation in page
        assert effect.source in page
        for parameter in effect.table:
            assert parameter.name in page
            assert f"{parameter.low:.4g} to {parameter.high:.4g}" in page
        for other in effect.indistinguishable_from:
            assert other in page
    for parameter in effect.table:
        assert f"| {parameter.name} | {parameter.unit} |" in section


def test_the_text_of_an_effect():
    assert catalogue_text(CartPole()).split("\n\n")[5].splitlines() == [
        "actuator_bias (actuation)",
        "  A constant added to every command; on a cart-pole, a force of max_force * offset.",
        "  u = command + offset",
        "  offset: -0.35 to 0.35, no effect at 0",
        "  systems: cartpole, quadrotor, fixed_wing",
        "  indistinguishable from: constant_force (separable on quadrotor, fixed_wing)",
        "  source: Ding (2013), Model-Based Fault Diagnosis Techniques, section 3.5 (additive actuator fault)",
    ]
