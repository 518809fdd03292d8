"""Targets of quadrotors that know no task, along references: they fly, are scored and adapted to as one with a task."""

from dataclasses import replace

import pytest
import torch

import visadapt as va
from tests.cli.commands import refused, run as command
from tests.flying import PERIOD, drag, seeded, waves
from visadapt.targets import TargetError
from visadapt.tasks.follow import Follow

COURSE = waves(1)


class Bare(va.FlightTarget):
    """A quadrotor with drag that starts on a reference but shows no goal, as an environment of gymnasium would."""

    def __init__(self, course=COURSE):
        super().__init__(Follow(course), va.Quadrotor(), drag(0.3))
        self.name = "bare"

    def _observe(self):
        return replace(super()._observe(), goal=None, task_state=None)


class Machine(va.Target):
    """The same as a target of one's own."""

    name, period, n_action = "machine", PERIOD, 4

    def __init__(self):
        self.bare = Bare()

    def reset(self, batch, generator):
        return self.bare.reset(batch, generator)

    def step(self, action):
        return self.bare.step(action)


@pytest.fixture(scope="module")
def policy():
    return va.load_policy(va.shipped("quadrotor"))


def test_it_is_flown_scored_and_filmed_as_a_target_with_the_task(policy, tmp_path):
    known = va.FlightTarget(Follow(COURSE), va.Quadrotor(), drag(0.3))
    given = va.FollowingTarget(Machine(), COURSE)
    assert va.score(policy, given, episodes=2) == va.score(policy, known, episodes=2)
    (one,), (other,) = (va.run(target, policy, 1, 10, seeded()) for target in (given, known))
    assert (one.episode.task_state == other.episode.task_state).all()
    va.film(policy, given, tmp_path / "film.mp4", seconds=0.5)
    assert (tmp_path / "film.mp4").stat().st_size > 1000


def test_references_from_elsewhere_or_at_other_instants_are_refused():
    far = replace(COURSE, positions=COURSE.positions + 2.0)
    with pytest.raises(TargetError, match=r"^machine: starts 3\.46 m from the first point of its reference;"):
        va.FollowingTarget(Machine(), far).reset(1, seeded())
    with pytest.raises(ValueError, match=r"rows 0\.2 s apart, and machine has 0\.1 s between actions"):
        va.FollowingTarget(Machine(), replace(COURSE, period=0.2))


def test_the_command_line_gives_references_to_a_target_without_a_goal(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    rows = torch.cat((torch.arange(41)[:, None] * PERIOD, COURSE.positions[0], COURSE.velocities[0]), 1)
    header = "time,x,y,z,x_dot,y_dot,z_dot"
    lines = (",".join(f"{cell:.9g}" for cell in row) for row in rows.tolist())
    (tmp_path / "course.csv").write_text("\n".join((header, *lines)) + "\n")
    (tmp_path / "bare_quadrotor.py").write_text("from tests.targets.test_following import Machine as make\n")
    flown = ("--policy", va.shipped("quadrotor"), "--target", "bare_quadrotor:make")
    assert "the target has none: give a quadrotor references" in refused(capsys, "score", *flown)
    course = ("--references", "course.csv")
    assert command("score", *flown, *course, "--episodes", 1) == 0
    assert "1 of 1 stayed near" in capsys.readouterr().out
    assert command("adapt", *flown, *course, "--samples", 40, "--round", 40, "--iterations", 2, "--out", "run") == 0
    assert va.load_policy("run/policy.safetensors").residual is not None
