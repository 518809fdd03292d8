"""Theorem 1's terms against what made the recording: a known force, a known policy, and the world's own steps."""

import dataclasses
import json
from types import SimpleNamespace

import jsonschema
import numpy as np
import pytest
import torch

from tests.diagnosed import GAINS, record
from tests.diagnosis.test_report import SCHEMA
from tests.own_systems import Pendulum
from visadapt import diagnose
from visadapt.cli import main as cli
from visadapt.diagnosis.policy_bound import actions, check, policy_terms
from visadapt.diagnosis.search.preparation import prepare
from visadapt.diagnosis.search.search import Search
from visadapt.effects import (
    ActuatorBacklash,
    ActuatorDelay,
    ActuatorGain,
    ActuatorLag,
    AngleOffset,
    ConstantForce,
)
from visadapt.estimation.candidate import CandidateModel
from visadapt.estimation.fit_states import CAREFUL
from visadapt.history import HORIZON, History
from visadapt.policies import ImagePolicy, Policy, StatePolicy
from visadapt.recordings import write_recording
from visadapt.setups.policy_file import save_policy
from visadapt.systems import CartPole
from visadapt.world import World

FORCE, PERIOD = 0.5, 0.05
MASS, LENGTH = 1.1, 0.5 * (4 / 3 - 0.1 / 1.1)  # of cart and pole; what turns the upright pole's push into a rotation
PER_NEWTON = np.hypot((1 + 0.05 / LENGTH / MASS) / MASS, 1 / MASS / LENGTH)  # m/s2 and rad/s2 of the upright pole


def linear(states):
    return states @ GAINS.to(states)[:, None]


def nothing(states):
    return 0 * states[:, :1]


def fitted(effect, **how):
    """Rows of a recording with an effect, and the fit of that effect alone."""
    rows = prepare(record([effect], **how), CartPole()).rows
    search = Search(CartPole(), rows, [type(effect)])
    best = search.single(type(effect))
    return SimpleNamespace(rows=rows, best=search.fit([(best.effects, best.fits)], CAREFUL)[0], source=search.source)


@pytest.fixture(scope="module")
def pushed():
    return fitted(ConstantForce(force=FORCE))


@pytest.fixture(scope="module")
def terms(pushed):
    return policy_terms(linear, CartPole(), pushed.rows, pushed.best)


def states_of(pushed):
    return pushed.best.fits.state[0, :, :-1].flatten(0, 1)


def step(world, state, action):
    return world.step(world.start(state), action[:, None]).state


class TestDelta:
    def test_before_is_what_the_force_does_in_a_step(self, terms):
        assert terms.delta[0] == pytest.approx(FORCE * PERIOD * PER_NEWTON, rel=0.02)

    def test_after_is_small_but_not_below_the_true_error(self, pushed, terms):
        wrong = abs(float(pushed.best.fits.theta) - FORCE) * PERIOD * PER_NEWTON
        assert wrong < terms.delta[1] < 0.02 * terms.delta[0]

    def test_an_unexplained_gap_remains_in_delta(self, pushed):
        found = policy_terms(linear, CartPole(), pushed.rows, pushed.source)
        assert found.delta[0] == found.delta[1] == pytest.approx(FORCE * PERIOD * PER_NEWTON, rel=0.25)

    def test_depends_on_what_the_policy_does(self):
        weak = fitted(ActuatorGain(scale=0.8))
        idle, busy = (policy_terms(policy, CartPole(), weak.rows, weak.best) for policy in (nothing, linear))
        acted = linear(states_of(weak)).abs().mean()
        assert idle.delta[0] < 0.02 * busy.delta[0]
        assert busy.delta[0] == pytest.approx(0.2 * 30 * float(acted) * PERIOD * PER_NEWTON, rel=0.05)


class TestOtherTerms:
    def test_lipschitz_is_the_motor_s(self, pushed, terms):
        state, world = states_of(pushed), World(CartPole())
        ends = [step(world, state, torch.full_like(state[:, 0], a)) for a in (0.995, 1.0)]
        assert terms.lipschitz[0] == pytest.approx(30 * PERIOD * PER_NEWTON, rel=0.02)
        assert terms.lipschitz[0] == pytest.approx(float((ends[1] - ends[0]).norm(dim=1).max()) / 0.005, rel=2e-3)

    def test_a_weaker_motor_has_a_lower_one(self):
        weak = fitted(ActuatorGain(scale=0.8))
        found = policy_terms(linear, CartPole(), weak.rows, weak.best)
        assert found.lipschitz[1] == pytest.approx(0.8 * found.lipschitz[0], rel=0.01)

    def test_the_best_command_and_zeta_against_brute_force(self, pushed, terms):
        state, tried = states_of(pushed), torch.linspace(-1, 1, 401, dtype=torch.float64)
        for column, effects in enumerate(([], [ConstantForce(force=FORCE).double()])):
            with torch.no_grad():
                every = step(World(CartPole(), effects), state.repeat_interleave(401, 0), tried.repeat(len(state)))
            away = (every.reshape(-1, 401, 4) - (1 - 1 / HORIZON) * state[:, None]).norm(dim=-1)
            least, best = away.min(1)
            # Between two of the commands tried the distance is up to 3e-4 less.
            assert terms.zeta[column] == pytest.approx(float(least.mean()), rel=2e-3)
            gap = (linear(state)[:, 0] - tried[best]).abs().mean()
            assert terms.action_gap[column] == pytest.approx(float(gap), abs=2e-3)

    def test_the_bound_holds_on_the_machine(self, pushed, terms):
        state = states_of(pushed)
        with torch.no_grad():
            after = step(World(CartPole(), [ConstantForce(force=FORCE).double()]), state, linear(state)[:, 0])
        error = float((after - (1 - 1 / HORIZON) * state).norm(dim=1).mean())
        assert error < terms.bound[1] < terms.bound[0]
        for k in (0, 1):
            assert terms.bound[k] == terms.delta[k] + terms.lipschitz[k] * terms.action_gap[k] + terms.zeta[k]


class TestHistories:
    class Spy(Policy):
        """Records its histories and commands 0."""

        def __init__(self):
            super().__init__(4, 1)
            self.given = []

        def act(self, history):
            self.given.append(history)
            return 0 * history.actions[:, -1]

    def test_histories_are_those_of_a_run(self, pushed):
        spy = self.Spy()
        policy_terms(spy, CartPole(), pushed.rows, pushed.best)
        windows, length = pushed.rows.shape
        observations = spy.given[-1].observations.reshape(windows, length - 1, 5, 4)
        done = spy.given[-1].actions.reshape(windows, length - 1, 5)
        state, command = pushed.best.fits.state[0].float(), pushed.rows.command[:, :length, 0].float()
        torch.testing.assert_close(observations[:, 10], state[:, 6:11], atol=1e-3, rtol=0)
        torch.testing.assert_close(observations[:, 1, :4], state[:, :1].expand(-1, 4, -1), atol=1e-3, rtol=0)
        torch.testing.assert_close(done[:, 10], command[:, 5:10])
        assert bool((done[:, 1, :4] == 0).all())
        torch.testing.assert_close(done[:, 1, 4], command[:, 0])

    def test_it_sees_what_the_sensors_read(self):
        off, spy = fitted(AngleOffset(offset=0.05)), self.Spy()
        policy_terms(spy, CartPole(), off.rows, off.best)
        seen = spy.given[-1].observations[:, -1, 2] - states_of(off)[:, 2]
        assert float(seen.mean()) == pytest.approx(0.05, abs=0.01)

    @pytest.mark.parametrize(
        "effect", [ActuatorDelay(delay=0.07), ActuatorLag(time_constant=0.06), ActuatorBacklash(width=0.1)]
    )
    def test_another_command_acts_with_the_actuator_s_memory(self, effect):
        rows = prepare(record(rows=150, episodes=2), CartPole()).rows  # two windows each
        theta = torch.tensor([next(effect.parameters()).item()], dtype=torch.float64)
        model = CandidateModel(CartPole(), [type(effect)], rows)
        window, row = 1, 20
        state = torch.zeros(*rows.shape, 4, dtype=torch.float64)
        begun = model.started(theta, state)[torch.tensor([window * rows.shape[1] + row])]
        given = rows.command[rows.episode[window], rows.first[window] + row][None]

        def acts(of, command):
            acting = of.commands(theta[None])[0][window, row][None]
            return of.at(theta).integrate(begun.time, begun.state, acting), of.at(theta).step(begun, command).state

        torch.testing.assert_close(*acts(model, given))
        changed = rows.command.clone()
        changed[rows.episode[window], rows.first[window] + row] += 0.3
        other = CandidateModel(CartPole(), [type(effect)], dataclasses.replace(rows, command=changed))
        torch.testing.assert_close(*acts(other, given + 0.3))


class TestWholeDiagnosis:
    def test_of_a_function(self):
        result = diagnose(record([ConstantForce(force=FORCE)]), World(CartPole()), [ConstantForce], policy=linear)
        assert result.policy.delta[0] == pytest.approx(FORCE * PERIOD * PER_NEWTON, rel=0.02)
        assert result.policy.bound[1] < result.policy.bound[0]

    def test_of_a_file(self, tmp_path, capsys, only_effects):
        only_effects("constant_force", "actuator_bias", "viscous_friction", "actuator_gain")
        run, saved, out, page = (tmp_path / name for name in ("run.h5", "p.safetensors", "a.json", "a.html"))
        recording = record([ConstantForce(force=FORCE)])
        write_recording(run, recording.episodes, recording.measured, ["command"])
        save_policy(saved, StatePolicy(4))
        arguments = ["--policy", saved, "--json", out, "--report", page]
        assert cli.main(["diagnose", str(run), "--system", "cartpole", *map(str, arguments)]) == 0
        delta = next(line for line in capsys.readouterr().out.splitlines() if "delta, error" in line)
        assert float(delta.split()[0]) == pytest.approx(FORCE * PERIOD * PER_NEWTON, rel=0.02)
        assert "What it means for the policy" in page.read_text()
        jsonschema.Draft202012Validator(SCHEMA).validate(json.loads(out.read_text()))


class TestNoPolicy:
    @pytest.mark.parametrize(
        ("policy", "message"),
        [
            (ImagePolicy(torch.zeros(100, 120), 1.0), "the policy sees frames"),
            (StatePolicy(12, 4), "made for 12 states and 4 actions; cartpole has 4 and 1"),
            (lambda states: states[:, 0], r"for states \(2, 4\) the policy gave the shape \(2,\)"),
            (lambda states: states[:, :1] / 0, "gave values that are not finite"),
        ],
    )
    def test_is_refused(self, policy, message):
        with pytest.raises(ValueError, match=message):
            check(policy, CartPole())

    def test_is_refused_before_the_search(self):
        with pytest.raises(ValueError, match="sees frames"):
            diagnose(record(), World(CartPole()), policy=ImagePolicy(torch.zeros(100, 120), 1.0))


class TestActions:
    """Of a pendulum whose motor is commanded from -2 to 2 N m."""

    history = History.start(torch.zeros(3, 2, dtype=torch.float64), 1)

    @pytest.mark.parametrize(("torque", "limited"), [(1.5, 1.5), (-9.0, -2.0), (9.0, 2.0)])
    def test_are_limited_to_the_range_of_the_system(self, torque, limited):
        chosen = actions(lambda states: torque * torch.ones(len(states), 1), Pendulum(), self.history)
        assert chosen.tolist() == [[limited]] * 3

    def test_of_another_shape_are_refused_with_the_range(self):
        message = (
            r"for states \(3, 2\) the policy gave the shape \(3, 2\); actions \(3, 1\) are right: torque from -2 to 2$"
        )
        with pytest.raises(ValueError, match=message):
            actions(lambda states: states, Pendulum(), self.history)
