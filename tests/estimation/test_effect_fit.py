"""Which effects a fit of given effects refuses; that it finds them is in tests/learning/test_named_effects.py."""

import pytest
import torch

import visadapt as va
from visadapt.effects import EFFECTS, MeasurementDelay
from visadapt.estimation.effect_fit import fit_effects, remembers


def fitted(system, *effects):
    state, command = (torch.zeros(30, len(each)) for each in (system.states, system.actions))
    return fit_effects(system, effects, [state + 1e-3 * torch.randn(state.shape)], [command], 0.05)


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
