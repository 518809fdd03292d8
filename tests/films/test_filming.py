"""`film`, the one call, on every kind of target; what each film looks like is tested beside its class."""

import math
from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import pytest
import torch
from matplotlib.colors import to_rgb

from experiments.flights import flight_target
from renderers import DrawnCartPole
from tests.flying import push, small_quadrotor
from visadapt.films import film
from visadapt.films.cartpole_film import CartPoleFilm, CartPolePanel
from visadapt.films.flight_film import FlightFilm
from visadapt.films.flight_panel import FlightPanel
from visadapt.films.widgets import INK
from visadapt.policies import ImagePolicy, StatePolicy
from visadapt.recordings import Episode
from visadapt.systems import CartPole
from visadapt.targets import Observation, Start, SyntheticTarget, Target, TargetError, sine_force
from visadapt.targets.rollout import Run, run
from visadapt.tasks.balance import within_a_turn

HANGING = Start(0.0, 0.0, math.pi, 0.0)


def seeded():
    return torch.Generator().manual_seed(3)


def state_policy():
    torch.manual_seed(0)
    return StatePolicy(4).eval()


def assert_shows(path: Path, expected) -> None:
    """The film at `path` has the frames of `expected`, as far as the encoding keeps them."""
    frames = imageio.imread(path, plugin="FFMPEG")
    assert len(frames) == len(expected.times)
    for i in (0, len(frames) // 2, -1):
        drawn = expected.still(expected.times[i])
        assert frames[i].shape == drawn.shape
        assert np.abs(frames[i].astype(float) - drawn).mean() < 2


class Camera(Target):
    """A cart-pole that shows frames of its own and nothing of its system, as a target of a user's own may."""

    name, period, n_action = "my rig", 0.05, 1

    def __init__(self, columns: int = 4, frames: bool = True):
        self.columns, self.frames = columns, frames

    def reset(self, batch: int, generator: torch.Generator) -> Observation:
        self.steps = 0
        return self.step(torch.zeros(batch, 1))

    def step(self, action: torch.Tensor) -> Observation:
        self.steps += 1
        frame = torch.full((len(action), 30, 40), 20 * self.steps, dtype=torch.uint8)
        state, alive = torch.zeros(len(action), self.columns), torch.ones(len(action), dtype=torch.bool)
        return Observation(state, alive, frame if self.frames else None)


def test_policies_that_balance_are_drawn_side_by_side_from_the_same_start(tmp_path: Path):
    target, policy = SyntheticTarget(sine_force), state_policy()
    titles = ("one", r"$4 \foo, not $3")  # text, no formula
    film(dict.fromkeys(titles, policy), target, tmp_path / "film.mp4", seconds=0.4, seed=3)
    episode = run(target, policy, 1, 8, seeded())[0]
    assert_shows(tmp_path / "film.mp4", CartPoleFilm([CartPolePanel(title, episode) for title in titles], 0.05))


def test_a_policy_on_frames_is_shown_them(tmp_path: Path):
    camera = DrawnCartPole()
    target, policy = SyntheticTarget(sine_force, camera), ImagePolicy(torch.full((100, 120), 0.9), 0.2).eval()
    film(policy, target, tmp_path / "film.mp4", seconds=0.2, seed=3)
    episode = run(target, policy, 1, 4, seeded())[0]
    assert_shows(
        tmp_path / "film.mp4", CartPoleFilm([CartPolePanel("synthetic cart-pole", episode, drawn=camera)], 0.05)
    )


def test_a_target_of_ones_own_is_shown_in_its_own_frames_or_drawn_from_its_states(tmp_path: Path):
    film(state_policy(), Camera(), tmp_path / "frames.mp4", seconds=0.2)
    scene = imageio.imread(tmp_path / "frames.mp4", plugin="FFMPEG")[:, 100:400, 100:400]
    np.testing.assert_allclose(scene.mean((1, 2, 3)), [20, 40, 60, 80, 100], atol=3)
    film(state_policy(), Camera(frames=False), tmp_path / "drawn.mp4", seconds=0.2)
    assert imageio.imread(tmp_path / "drawn.mp4", plugin="FFMPEG")[0, 100:400, 100:400].mean() > 200


def test_without_a_camera_the_pole_has_its_length_and_the_cart_is_seen_wherever_it_goes(tmp_path: Path):
    target = SyntheticTarget(system=CartPole(pole_half_length=0.15))
    time = np.arange(3) * 0.05
    states = np.array([[1.0, 1, 0, 0], [2.0, 1, 0, 0], [2.47, 1, 0.1, 0]])
    far = Run(Episode(time, np.zeros((3, 1)), states), False, None)
    film(far, target, tmp_path / "film.mp4")
    panel = CartPolePanel("synthetic cart-pole", far, drawn=DrawnCartPole(pole_length=0.3), position_limit=math.inf)
    assert panel.failure(2, 5.0) == "ENDED at t = 0.10 s"
    expected = CartPoleFilm([panel], 0.05)
    assert_shows(tmp_path / "film.mp4", expected)
    for t in (0.0, 0.05):
        scene = expected.still(t)[56:456, 28:508]
        assert (np.abs(scene - 255 * np.array(to_rgb(INK))).max(-1) < 30).sum() > 500  # the cart


def test_a_cart_pole_without_an_angle_limit_is_filmed_as_a_swing_up(tmp_path: Path):
    target, policy = SyntheticTarget(start=HANGING, angle_limit=math.inf), state_policy()
    film(policy, target, tmp_path / "film.mp4", seconds=0.4, seed=3, due=0.2)
    episode = run(target, policy, 1, 8, seeded(), see=lambda seen: within_a_turn(seen.state))[0]
    assert_shows(
        tmp_path / "film.mp4",
        CartPoleFilm([CartPolePanel("synthetic cart-pole", episode, angle_limit=math.inf)], 0.05, 0.2),
    )


def test_a_vehicle_is_filmed_with_its_course_to_its_end(tmp_path: Path):
    setup = small_quadrotor(rows=4)
    target, policy = flight_target(setup, push(1.0)), setup.policy().eval()
    film(policy, target, tmp_path / "policy.mp4", seed=3)
    flown = run(target, policy, 1, 3, seeded())[0]
    expected = FlightFilm([FlightPanel("synthetic vehicle", flown, target.system, target.task, target.first[0])])
    assert expected.duration == pytest.approx(0.3)
    assert_shows(tmp_path / "policy.mp4", expected)
    film(flown, target, tmp_path / "run.mp4")
    assert_shows(tmp_path / "run.mp4", expected)


def a_run(columns: int) -> Run:
    time = np.arange(3) * 0.05
    return Run(Episode(time, np.zeros((3, 1)), np.zeros((3, columns))), True, np.zeros(3))


def test_what_cannot_be_filmed_is_one_line_and_leaves_no_file(tmp_path: Path):
    flight = flight_target(small_quadrotor(rows=6))
    image = ImagePolicy(torch.full((100, 120), 0.9), 0.2)
    for shown, target, says in (
        ({}, SyntheticTarget(), "at least one panel"),
        (a_run(2), Camera(), "panel 'my rig': a cart-pole's states"),
        (a_run(13), flight, "does not hold its progress in the task"),
        (image, SyntheticTarget(), "give it a camera"),
    ):
        with pytest.raises((ValueError, TargetError), match=says) as caught:
            film(shown, target, tmp_path / "film.mp4")
        assert "\n" not in str(caught.value)
    assert not list(tmp_path.iterdir())
