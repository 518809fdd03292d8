import pytest

from benchmarks.data_collection import REACH, random_policy
from experiments.flights import flight_target
from tests.flying import drag, seeded, small_quadrotor
from visadapt.setups.flight import fixed_wing
from visadapt.targets.rollout import run


@pytest.mark.parametrize("made", [small_quadrotor, fixed_wing])
def test_a_random_policy_moves_every_command_and_keeps_a_vehicle_in_reach_for_a_while(made):
    setup = made()
    target = flight_target(setup, drag(0.3), test=False, reach=REACH)
    for each in run(target, random_policy(setup, setup.policy()), 8, 20, seeded(), exploration=0.05):
        assert each.episode.samples == 20
        assert (each.episode.action[:-1].std(0) > 0.02).all()
