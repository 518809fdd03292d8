import pytest

from benchmarks.data_collection import REACH, random_policy
from tests.flying import drag, seeded, small_flight
from visadapt.setups.flight import fixed_wing
from visadapt.targets.rollout import run, see_goals


@pytest.mark.parametrize("made", [small_flight, fixed_wing])
def test_a_random_policy_moves_every_command_and_keeps_a_vehicle_in_reach_for_a_while(made):
    flight = made()
    target = flight.target(drag(0.3), test=False, reach=REACH)
    for each in run(target, random_policy(flight), see_goals, 8, 20, seeded(), exploration=0.05):
        assert each.episode.samples == 20
        assert (each.episode.action[:-1].std(0) > 0.02).all()
