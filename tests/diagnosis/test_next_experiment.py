from types import SimpleNamespace
from typing import Any

import pytest

from visadapt.diagnosis.next_experiment import explain, separate
from visadapt.diagnosis.result import AMBIGUOUS, Cause, Gap
from visadapt.diagnosis.search.causes import Alternative
from visadapt.diagnosis.search.unexplained import SmoothFunction
from visadapt.diagnosis.verdict import next_step, of_many
from visadapt.effects import (
    ActuatorBias,
    Brightness,
    ConstantForce,
    CoulombFriction,
    Effect,
    Gamma,
    PeriodicForce,
    QuadraticDrag,
    Spring,
    ViscousFriction,
)
from visadapt.systems import CartPole, Quadrotor


def test_the_experiments_of_all_pairs_of_a_class_are_advised():
    advice = separate([[CoulombFriction, QuadraticDrag, ViscousFriction], [Spring]], CartPole())
    assert advice == (
        "To tell coulomb_friction, quadratic_drag and viscous_friction apart: record faster motions: drag grows with "
        "the square of the speed; record slow reversals and fast runs: dry friction is as large at any speed and stops "
        "the cart near standstill."
    )


def test_one_that_no_experiment_settles_gets_a_general_one():
    advice = separate([[ViscousFriction, ActuatorBias, ConstantForce]], CartPole())
    assert "spring balance" in advice
    assert "free motions with the motor off" in advice


def test_slight_causes_need_no_experiment():
    search: Any = SimpleNamespace(system=CartPole())
    nothing: Any = None
    pairs: list[list[type[Effect]]] = [[ActuatorBias, ConstantForce], [CoulombFriction, QuadraticDrag]]
    groups = [[Alternative(effect, nothing, effect) for effect in pair] for pair in pairs]
    found = [Cause(effect.name, {}, 0.5, 0.5, slight=pair is pairs[1]) for pair in pairs for effect in pair]
    comparison: Any = SimpleNamespace(unexplained=lambda improvable: True)
    gap = Gap("", 100.0, 4.0, 1.0, 4.0, 0.97)
    advice = next_step(search, comparison, AMBIGUOUS, groups, found, gap, (), (), (), False)
    assert advice.startswith("To tell actuator_bias and constant_force apart: ")
    assert "friction" not in advice


def test_every_member_of_a_class_is_told_apart():
    advice = separate([[ActuatorBias, ConstantForce, PeriodicForce]], CartPole())
    assert "an actuator bias is gone" in advice
    assert "a periodic force comes and goes" in advice


def test_gamma_and_brightness_are_told_apart_by_known_grey_levels():
    assert "a card with several known grey levels" in separate([[Brightness, Gamma]], CartPole())


def test_an_experiment_for_a_cart_is_not_advised_on_a_vehicle_which_needs_none():
    pair = [ConstantForce, ActuatorBias]
    assert "spring balance" in separate([pair], CartPole())
    assert "spring balance" not in separate([pair], Quadrotor())
    assert "flights" in separate([pair], Quadrotor())


@pytest.mark.parametrize(
    ("port", "of_reading", "said"),
    [
        ("cart_force", False, "An unexplained load (cart force) depends on x dot: record runs that cover"),
        ("theta", True, "An unexplained error of the reading of theta depends on x dot: record runs that cover"),
    ],
)
def test_a_disturbance_is_a_load_or_an_error_of_a_reading(port, of_reading, said):
    assert explain([SmoothFunction(port, of_reading, "x_dot", 12.0)]).startswith(said)


def test_what_repeats_in_every_turn_is_looked_for_in_whole_turns():
    advice = explain([SmoothFunction("motor_shaft", False, "motor_within_a_turn", 264.3)])
    assert advice.startswith("An unexplained load (motor shaft) depends on motor within a turn: record runs that cover")
    assert "whole turns of motor slowly and fast" in advice


def test_a_variable_that_the_data_do_not_show_is_not_named():
    advice = explain([SmoothFunction("motor_shaft", False, "time", -0.5)])
    assert advice.startswith("An unexplained load (motor shaft) depends on no single state, command or time: record")


def test_what_depends_on_time_is_looked_for_in_repeated_runs():
    assert "several long runs under the same commands" in explain([SmoothFunction("cart_force", False, "time", 12.0)])


@pytest.mark.parametrize(
    ("variable", "log_odds", "of_reading", "pushes"),
    [("time", 12.0, False, True), ("x", -0.5, False, True), ("x", 12.0, False, False), ("time", 12.0, True, False)],
)
def test_a_load_of_no_state_on_a_joint_that_was_pushed_is_the_pushes(variable, log_odds, of_reading, pushes):
    advice = explain([SmoothFunction("hinge", of_reading, variable, log_odds)], ["hinge"])
    assert advice.startswith("Pushes on hinge were found: record runs in which nothing touches the machine") == pushes
    assert "Pushes" not in explain([SmoothFunction("hinge", of_reading, variable, log_odds)], ["slide"])


def test_variables_on_which_it_may_depend_as_well_are_named_beside_the_first():
    first = SmoothFunction("pivot", False, "previous_command", 9.5)
    others = [
        SmoothFunction("pivot", False, "command", 9.4),
        SmoothFunction("other", False, "theta", 9.3),
        SmoothFunction("pivot", True, "pivot", 9.2),
        SmoothFunction("pivot", False, "time", 4.0),
    ]
    assert explain([first, *others]).startswith("An unexplained load (pivot) depends on previous command or command:")


def test_many_causes_at_once_are_doubted():
    assert of_many(3) == []
    (said,) = of_many(5)
    assert said.startswith("5 causes at once may stand for one effect that is not in the catalogue")
