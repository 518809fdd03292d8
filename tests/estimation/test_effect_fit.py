"""Which effects a fit of given effects refuses; that it finds them is in tests/learning/test_named_effects.py."""

import pytest
import torch

import visadapt as va
from visadapt.effects import EFFECTS, ActuatorBias, ActuatorDelay, ConstantForce, MeasurementDelay, Payload, ThrustGain
from visadapt.estimation.effect_fit import fit_effects, remembers


def fitted(system, *effects):
    state, command = (torch.zeros(30, len(each)) for each in (system.states, system.actions))
    return fit_effects(system, effects, [state + 1e-3 * torch.randn(state.shape)], [command], 0.05)


@pytest.mark.parametrize(
    ("system", "effects"),
    [
        (va.CartPole(), (ActuatorDelay(delay=0.0), MeasurementDelay(delay=0.0))),
        (va.CartPole(), (ActuatorBias(offset=0.0), ConstantForce(force=0.0))),
        (va.CartPole(cart_mass=5.0), (ConstantForce(force=0.0), ActuatorBias(offset=0.0))),
        (va.Quadrotor(), (ThrustGain(scale=1.0), Payload(mass=0.0))),
    ],
)
def test_twins_are_refused_by_name(system, effects):
    one, other = (effect.name for effect in effects)
    with pytest.raises(ValueError, match=f"passive data cannot tell apart {one} and {other}: leave one of them out"):
        fitted(system, *effects)


def test_twins_that_data_of_the_system_separate_are_fitted_together():
    names = {kind.name for kind in fitted(va.Quadrotor(), *made(va.Quadrotor())).values}
    assert names == {"actuator_bias", "constant_force"}


def made(system):
    return [kind(**dict.fromkeys((p.name for p in kind.table), 0.0)) for kind in (ActuatorBias, ConstantForce)]


def test_an_effect_that_is_given_twice_is_refused():
    with pytest.raises(ValueError, match="constant_force is given more than once"):
        fitted(va.CartPole(), ConstantForce(force=0.0), ConstantForce(force=1.0))


class SlowGyros(va.SensingEffect):
    """Rate gyros of a vehicle, columns 10 to 12, whose reading follows the rate."""

    name = "slow_gyros"
    systems = (va.Quadrotor,)
    table = (va.Parameter("share", "1", 0.0, 1.0, 0.0),)

    def memory(self, state, period):
        return state[:, None, 10:]

    def apply_to(self, measured, memory, period, generator):
        read = torch.lerp(measured[:, 10:], memory[:, 0], self.value("share", measured))
        return torch.cat((measured[:, :10], read), 1), read[:, None]


EFFECTS.pop("slow_gyros")


def test_the_memory_of_a_sensor_is_looked_for_in_all_states_of_its_system():
    assert remembers(SlowGyros, va.Quadrotor())
    with pytest.raises(ValueError, match="slow_gyros cannot be fitted: what it measures depends on earlier rows"):
        fitted(va.Quadrotor(), SlowGyros(share=0.2))
    assert not remembers(MeasurementDelay, va.CartPole())


@pytest.mark.parametrize(
    "known", [va.effects.ActuatorSaturation(limit=0.6), va.effects.FrictionPatch(start=0.5, end=0.7, coefficient=20.0)]
)
def test_what_the_samples_do_not_show_stays_as_it_was_known(known):
    generator = torch.Generator().manual_seed(0)
    (run,) = va.run(va.SyntheticTarget(), va.load_policy(va.shipped("cartpole_states")), 1, 60, generator, 0.05)
    state, command = torch.from_numpy(run.episode.state), torch.from_numpy(run.episode.action)
    assert command.abs().max() < 0.5
    assert state[:, 0].abs().max() < 0.4
    noise = torch.tensor([0.002, 0.01, 0.002, 0.01]) * torch.randn(state.shape, generator=generator)
    found = fit_effects(va.CartPole(), [known], [state + noise], [command], 0.05)
    values = torch.stack([getattr(known, p.name) for p in known.table]).detach().double()
    torch.testing.assert_close(found.values[type(known)], values, rtol=0.05, atol=0)


def test_an_effect_of_the_camera_is_not_fitted_to_states():
    with pytest.raises(ValueError, match="camera_rotation cannot be fitted to states: only frames show it"):
        fitted(va.CartPole(), va.effects.CameraRotation(angle=0.1))
