"""Targets of fixed wings that know no task, through points: they fly and are scored as one with the task."""

import pytest
import torch

import visadapt as va
from tests.cli.commands import run as command
from tests.flying import seeded
from visadapt.targets import TargetError
from visadapt.tasks.reach import Reach


class Wing(va.Target):
    """A wing that starts in level flight `away` m to the side of the origin, and shows no goal but the states that are
    `shown`; `turned`, it flies against x."""

    name, period, n_action, system = "wing", 0.05, 4, va.FixedWing

    def __init__(self, away=0.0, shown=13, turned=False):
        self.known, self.away, self.shown, self.turned = va.FlightTarget(Reach(), va.FixedWing()), away, shown, turned

    def _shown(self, seen):
        state = seen.state.clone()
        state[:, 1] += self.away
        state[:, 3] *= -1 if self.turned else 1
        return va.Observation(state[:, : self.shown], seen.alive)

    def reset(self, batch, generator):
        return self._shown(self.known.reset(batch, torch.Generator().manual_seed(9)))

    def step(self, action):
        return self._shown(self.known.step(action))


def test_it_is_flown_and_scored_as_a_target_with_the_task():
    policy = va.load_policy(va.shipped("fixed_wing"))
    known, given = va.FlightTarget(Reach(), va.FixedWing()), va.ReachingTarget(Wing())
    assert va.score(policy, given, episodes=2) == va.score(policy, known, episodes=2)


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"away": 3.0}, "starts 3 m from the origin; positions from where a flight starts are right"),
        ({"turned": True}, r"starts at \(-11.[0-9]+, .*\) m/s, not towards the points ahead, which lie along x"),
        ({"shown": 2}, "shows 2 states; the 13 of its vehicle are right"),
    ],
)
def test_a_flight_that_starts_elsewhere_or_shows_other_states_is_refused(wrong, said):
    with pytest.raises(TargetError, match=f"^wing: {said}"):
        va.ReachingTarget(Wing(**wrong)).reset(1, seeded())


def test_the_command_line_gives_points_to_a_target_without_a_goal(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "bare_wing.py").write_text("from tests.targets.test_reaching import Wing as make\n")
    assert command("score", "--policy", va.shipped("fixed_wing"), "--target", "bare_wing:make", "--episodes", 2) == 0
    assert "2 of 2" in capsys.readouterr().out
