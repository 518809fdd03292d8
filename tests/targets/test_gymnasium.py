"""The adapter of gymnasium environments, on a toy of our own and on MuJoCo's InvertedPendulum-v5."""

import dataclasses
import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.own_systems import Pendulum
from visadapt.systems import CartPole, Quadrotor
from visadapt.targets.base import TargetError
from visadapt.targets.env_map import Entry, EnvMap
from visadapt.targets.gymnasium import GymnasiumTarget
from visadapt.targets.inverted_pendulum import MAP as PENDULUM
from visadapt.world import World

pytest.importorskip("gymnasium")
import gymnasium

STATES = {"x": Entry(0), "x_dot": Entry(1), "theta": Entry(2, scale=-1.0, offset=0.5), "theta_dot": Entry(3)}
MAP = EnvMap(STATES, (Entry(1, scale=-2.0),), crop=(0, 0, 120, 100), limits={"x": 1.0})


class Toy(gymnasium.Env):
    """x moves by its action's second entry; the rest stands still. The picture is a grey of 10."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}  # noqa: RUF012
    action_space = gymnasium.spaces.Box(-2, 2, (2,))
    observation_space = gymnasium.spaces.Box(-10, 10, (4,))

    def __init__(self, size=(100, 120, 3), broken_at=None, cut_at=None, render_mode="rgb_array"):
        self.render_mode, self.size, self.broken_at, self.cut_at = render_mode, size, broken_at, cut_at

    def reset(self, seed=None, options=None):
        super().reset(seed=seed)
        self.seen, self.steps = np.array([0, 0, self.np_random.uniform(), 0]), 0
        return self.seen.copy(), {}

    def step(self, action):
        self.steps += 1
        self.seen[0] += action[1]
        if self.steps == self.broken_at:
            self.seen[3] = np.nan
        return self.seen.copy(), 0.0, False, self.steps == self.cut_at, {}

    def render(self):
        return np.full(self.size, 10, np.uint8)


def target(mapping=MAP, **toy):
    return GymnasiumTarget(lambda: Toy(**toy), mapping, name="toy")


def needs_mujoco():
    """Without importing it: where MUJOCO_GL names what is not there, that fails in other ways than ImportError."""
    if importlib.util.find_spec("mujoco") is None:
        pytest.skip("mujoco is not installed")


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def test_maps_states_actions_and_frames():
    toy = target(dataclasses.replace(MAP, contrast=(0.0, 20.0)))
    start = toy.reset(2, generator())
    assert (toy.period, toy.period_origin[:15]) == (0.05, "render_fps = 20")
    assert start.frame.shape == (2, 100, 120)
    assert start.frame.dtype == torch.uint8
    assert (start.frame == 128).all()  # 10 of 20, rounded to even
    after = toy.step(torch.tensor([[0.25], [-5.0]]))
    torch.testing.assert_close(after.state[:, 0], torch.tensor([-0.5, 2.0]))  # scale -2, the command clamped to -1
    assert after.alive.tolist() == [True, False]
    torch.testing.assert_close(0.5 - start.state[:, 2], torch.tensor([e.seen[2] for e in toy._envs]).float())
    still = toy.step(torch.ones(2, 1))
    assert still.state[1, 0] == 2.0  # an episode that has ended stays as it was


@pytest.mark.parametrize(
    ("toy", "says"),
    [
        ({"broken_at": 2}, r"toy: observation entry 3 is nan after step 2 \(episode 0\)"),
        ({"cut_at": 2}, "toy: cut the episode short after 2 steps; make it without a time limit"),
        ({"size": (90, 120, 3)}, "toy: its frames are 120 x 90 px, but the crop reaches to column 120 and row 100"),
        ({"size": (100,)}, r"toy: render\(\) gave uint8 \(100,\); a picture"),
        ({"size": (100, 120, 4)}, r"toy: render\(\) gave uint8 \(100, 120, 4\); a picture"),
        ({"render_mode": None}, 'toy: its render_mode is None .* made with render_mode="rgb_array"'),
        ({"render_mode": "human"}, "toy: its render_mode is 'human'"),
    ],
)
def test_an_environment_that_does_not_do_is_one_clear_line(toy, says):
    def drive():
        env = target(**toy)
        env.reset(1, generator())
        for _ in range(3):
            env.step(torch.zeros(1, 1))

    with pytest.raises(TargetError, match=says) as error:
        drive()
    assert "\n" not in str(error.value)


def returning(reset=None, step=None):
    """A target whose environment's reset or step returns, or raises, something else."""

    class Other(Toy):
        def reset(self, seed=None, options=None):
            super().reset(seed, options)
            return reset if reset is not None else (self.seen, {})

        def step(self, action):
            if isinstance(step, Exception):
                raise step
            return step

    return GymnasiumTarget(Other, MAP, name="toy")


def test_a_reset_without_a_seed_is_told_what_is_right():
    class Seedless(Toy):
        def reset(self):  # type: ignore[override]
            return super().reset()

    says = r"reset\(\) failed: TypeError: .*'seed' \(def reset\(self, \*, seed=None, options=None\) is right\)$"
    with pytest.raises(TargetError, match=says):
        GymnasiumTarget(Seedless, MAP, name="toy").reset(1, generator())


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"reset": np.zeros(4)}, r"toy: reset\(\) returned a ndarray; observation, info are right"),
        ({"reset": (np.zeros(2), {})}, r"reset\(\) returned an observation of shape \(2,\); .* says \(4,\)"),
        # gymnasium's predecessor gym returned four values.
        ({"step": (np.zeros(4), 0.0, False, {})}, r"step\(\) returned 4 values; observation, reward, term"),
        ({"step": (np.zeros(2), 0.0, False, False, {})}, r"step\(\) returned an observation of shape \(2,\)"),
        ({"step": (None, 0.0, False, False, {})}, r"step\(\) returned an observation of shape \(\)"),
        (
            {"step": OSError("the port is gone")},
            r"toy: step\(\) failed: OSError: the port is gone \(.*test_gymnasium.py, line \d+\)$",
        ),
    ],
)
def test_an_environment_that_raises_or_returns_something_else_is_one_line(wrong, says):
    env = returning(**wrong)
    with pytest.raises(TargetError, match=says):
        env.reset(1, generator()), env.step(torch.zeros(1, 1))


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"states": {**STATES, "x": Entry(4)}}, "takes x from observation entry 4; there are 4, counted from 0"),
        ({"actions": (Entry(2),)}, "sets action entry 2; there are 2"),
        ({"actions": (Entry(0), Entry(1))}, "has 2 actions, cartpole has 1"),
        ({"actions": (Entry(0, 1.5, offset=1.0),)}, "entry 0 from -0.5 to 2.5, the environment takes -2 to 2: change"),
        ({"options": {"width": 120}}, "toy: the map's options are for gymnasium.make, but a function makes this"),
        ({"states": {"x": Entry(0)}}, "ours are x, x_dot, theta, theta_dot"),
        ({"limits": {"height": 1.0}}, "limits 'height'"),
        ({"start": {"height": 1.0}}, "starts 'height'"),
    ],
)
def test_a_map_that_does_not_fit_the_environment(change, says):
    with pytest.raises(TargetError, match=says):
        target(dataclasses.replace(MAP, **change))


def test_commands_of_a_system_of_ones_own_keep_their_units_and_range():
    states = {"angle": Entry(0), "rate": Entry(1)}
    pendulum = GymnasiumTarget(Toy, EnvMap(states, (Entry(1),), period=0.05), Pendulum, frames=False, name="toy")
    start = pendulum.reset(2, generator())
    after = pendulum.step(torch.tensor([[1.5], [-5.0]]))
    assert (after.state - start.state)[:, 0].tolist() == [1.5, -2.0]  # N m, of at most 2
    with pytest.raises(TargetError, match="sets action entry 1 from -4 to 4, the environment takes -2 to 2"):
        GymnasiumTarget(Toy, EnvMap(states, (Entry(1, scale=2.0),)), Pendulum, frames=False, name="toy")


def test_two_commands_cannot_set_the_same_entry():
    states = {variable.name: Entry(i) for i, variable in enumerate(Quadrotor.states)}
    mapping = EnvMap(states, tuple(Entry(index) for index in (0, 1, 1, 2)))
    with pytest.raises(TargetError, match="toy: the map sets action entry 1 more than once"):
        mapping.check("toy", Quadrotor, 13, 4)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"crop": (10, 0, 10, 100)}, "holds no pixel"),
        (
            {"crop": (0, 0, 100, 100), "width": 120},
            "100 x 100 px, 1.000 wide for 1 high; frames of 120 x 100 px need 1.200",
        ),
        ({"crop": (0, 0, 100)}, "crop must be left, top, right, bottom"),
        ({"start": {"x": 0.0}}, "start: x must be positive, got 0.0"),
        ({"period": -0.05}, "period must be a positive number of seconds, got -0.05"),
        ({"contrast": (5.0, 5.0)}, "two rising grey levels"),
        ({"contrast": ("a", "b")}, "two rising grey levels"),
        ({"height": 100.0}, "height must be a positive whole number of px, got 100.0"),
        ({"crop": None, "width": 0}, "width must be a positive whole number of px, got 0"),
        ({"limits": {"x": -1.0}}, "x must be positive"),
        ({"actions": ()}, "actions is empty"),
    ],
)
def test_a_map_that_cannot_be(change, says):
    with pytest.raises(TargetError, match=says):
        dataclasses.replace(MAP, **change)
    with pytest.raises(TargetError, match="scale must not be 0"):
        Entry(0, scale=0)


TOML = """
actions = [{ index = 1, scale = -2.0 }]
crop = [0, 0, 120, 100]
[limits]
x = 1.0
[states]
x = { index = 0 }
x_dot = { index = 1 }
theta = { index = 2, scale = -1.0, offset = 0.5 }
theta_dot = { index = 3 }
"""


def test_a_map_can_be_a_toml_file(tmp_path):
    path = tmp_path / "rig.toml"
    path.write_text(TOML)
    assert EnvMap.load(path) == MAP
    for old, new, says in (
        ("crop", "clip", "unknown key 'clip'; there are states, actions, period, crop"),
        ("actions = [{ index = 1, scale = -2.0 }]", "", "'actions' is missing"),
        ("crop =", "period = 0\ncrop =", "period must be a positive number"),
        ("index = 3", "index = -3", "index must be a whole number from 0 on, got -3"),
        ("index = 3", "column = 3", "unexpected keyword argument 'column'"),
        ("crop = [0, 0", 'crop = ["left", 0', "crop must be left, top, right, bottom in whole px"),
        ("[limits]", "[limits", "not TOML"),
    ):
        path.write_text(TOML.replace(old, new))
        with pytest.raises(TargetError, match=r"rig\.toml: ") as error:
            EnvMap.load(path)
        assert says in str(error.value)


def test_a_crop_of_any_shape_and_none():
    for crop, height, shape in (((0, 0, 60, 90), 30, (30, 20)), (None, 50, (50, 60))):
        toy = target(dataclasses.replace(MAP, crop=crop, height=height))
        assert toy.reset(1, generator()).frame.shape == (1, *shape)
    squeezed = target(dataclasses.replace(MAP, crop=None, width=50))
    with pytest.raises(TargetError, match=r"its frame is 120 x 100 px, 1\.200 wide for 1 high; .* need 0\.500"):
        squeezed.reset(1, generator())


class Clocked(Toy):
    """A toy that says how long its step is."""

    tau = 0.02


def test_an_environment_of_an_id_holds_each_action_for_all_steps_of_the_period():
    own, slow = (
        GymnasiumTarget("InvertedPendulum-v5", dataclasses.replace(PENDULUM, period=period), frames=False)
        for period in (None, 0.08)
    )
    push = torch.full((1, 1), 0.2)
    for target in (own, slow):
        target.reset(1, generator())
    own.step(push)
    torch.testing.assert_close(slow.step(push).state, own.step(push).state)
    assert (own.period, slow.period) == (0.04, 0.08)


def clocked(period=None):
    return GymnasiumTarget(Clocked, dataclasses.replace(MAP, period=period), name="toy")


def test_a_period_comes_from_the_map_or_the_environment_s_own_clock_or_with_a_warning_from_its_films(recwarn):
    assert (clocked().period, clocked().period_origin) == (0.02, "its tau")
    assert (clocked(0.04).period, clocked(0.04).period_origin) == (0.04, "as given")
    assert not recwarn
    with pytest.raises(TargetError, match=r"its tau says 0.02 s a step, so that the period given, 0.05 s, is no whole"):
        clocked(0.05)
    with pytest.raises(TargetError, match=r"the period given, 0\.002 s"):
        clocked(0.002)
    with pytest.warns(UserWarning, match=r"toy: the period, 0.05 s, is taken from render_fps = 20"):
        target()


class Kept(Toy):
    """A toy that keeps what it observes as its state, as gymnasium's classic control does."""

    def reset(self, seed=None, options=None):
        self.state, nothing = super().reset(seed, options)
        return self.state.copy(), nothing

    def step(self, action):
        self.seen = np.array(self.state)
        self.state, *rest = super().step(action)
        return self.state.copy(), *rest

    def render(self):
        return np.full(self.size, round(100 * abs(self.state[0])), np.uint8)


def test_an_environment_that_a_function_makes_is_held_for_all_steps_of_the_period_too():
    toy = clocked(0.06)
    toy.reset(1, generator())
    assert toy.held == 3
    torch.testing.assert_close(toy.step(torch.full((1, 1), 0.1)).state[:, 0], torch.tensor([-0.6]))


class Repeating(gymnasium.Wrapper):
    """A wrapper that says how long its step is, of an environment whose tau and dt are others."""

    dt = 0.06


class Motor(Clocked):
    """tau is the time constant of its motor."""

    tau = 0.3
    dt = 0.05


@pytest.mark.parametrize(
    ("make", "period", "held"), [(Motor, 0.05, 1), (Motor, 0.1, 2), (lambda: Repeating(Clocked()), 0.06, 1)]
)
def test_the_step_is_that_of_what_the_environment_states_which_fits_the_period(make, period, held):
    assert GymnasiumTarget(make, dataclasses.replace(MAP, period=period), name="toy").held == held


def test_an_environment_that_keeps_its_observation_as_its_state_shows_and_starts_in_any():
    mapping = dataclasses.replace(MAP, start={"x": 0.5, "theta": 0.2}, contrast=(0.0, 255.0))
    toy = GymnasiumTarget(Kept, mapping, name="kept")
    frames = toy.show(np.array([[0.3, 0, 0, 0], [0.7, 0, 0.1, 0]]))
    assert [int(frame.max()) for frame in frames] == [30, 70]
    start = toy.reset(64, generator()).state
    assert 0.4 < start[:, 0].abs().max() <= 0.5
    assert 0.15 < start[:, 2].abs().max() <= 0.2
    assert (start[:, [1, 3]] == 0).all()
    after = toy.step(torch.full((64, 1), 0.1)).state
    torch.testing.assert_close(after[:, 0], start[:, 0] - 0.2)


def test_one_that_does_not_keep_it_says_so():
    with pytest.raises(TargetError, match="toy: cannot be put into a state"):
        target().show(np.zeros((1, 4)))


def test_gymnasium_s_own_cart_pole_starts_where_it_is_put():
    def make():
        return gymnasium.wrappers.TransformAction(
            gymnasium.make("CartPole-v1", max_episode_steps=-1),
            lambda action: int(action[0] > 0),
            gymnasium.spaces.Box(-1, 1, (1,)),
        )

    mapping = EnvMap({name: Entry(i) for i, name in enumerate(("x", "x_dot", "theta", "theta_dot"))}, (Entry(0),))
    start = dataclasses.replace(mapping, start={"x": 1.0, "x_dot": 0.5, "theta": 0.1, "theta_dot": 0.2})
    target = GymnasiumTarget(make, start, frames=False)
    before = target.reset(32, generator()).state
    assert before[:, 0].abs().max() > 0.9
    after = target.step(torch.ones(32, 1)).state
    torch.testing.assert_close(after[:, 0], before[:, 0] + target.period * before[:, 1])


def test_discrete_actions():
    with pytest.raises(TargetError, match=r"CartPole-v1: its actions are Discrete\(2\).*InvertedPendulum-v5"):
        GymnasiumTarget("CartPole-v1", MAP, frames=False)


def test_an_unknown_environment():
    with pytest.raises(TargetError, match="NoSuchThing-v0: cannot be made"):
        GymnasiumTarget("NoSuchThing-v0", MAP)


def test_stepping_before_a_reset_or_with_an_action_that_is_not_finite():
    toy = target()
    with pytest.raises(TargetError, match="a reset first"):
        toy.step(torch.zeros(1, 1))
    toy.reset(2, generator())
    with pytest.raises(TargetError, match=r"it needs \(2, 1\)"):
        toy.step(torch.zeros(1, 1))
    with pytest.raises(TargetError, match="the action of step 0 is not finite"):
        toy.step(torch.full((2, 1), torch.nan))


def test_without_a_renderer_it_says_what_to_install():
    needs_mujoco()
    script = "from visadapt.targets.inverted_pendulum import inverted_pendulum; inverted_pendulum()"
    root = Path(__file__).parents[2]
    env = {**os.environ, "MUJOCO_GL": "nonsense", "PYTHONPATH": str(root)}
    done = subprocess.run([sys.executable, "-c", script], env=env, capture_output=True, text=True, cwd=root)
    last = done.stderr.strip().splitlines()[-1]
    assert "cannot render off-screen (MUJOCO_GL is nonsense" in last
    assert "apt-get install libegl1" in last
    assert "libosmesa6" in last


@pytest.fixture(scope="module")
def pendulum():
    needs_mujoco()
    from visadapt.targets.inverted_pendulum import inverted_pendulum

    try:
        made = inverted_pendulum()
    except TargetError as error:
        if "cannot render" not in str(error):
            raise
        pytest.skip(str(error))
    yield made
    made.close()


def centre(frame):
    """Column of the centre of what is bright, leaving out the row of the rail."""
    weight = frame.astype(float) * (frame > 60)
    return (weight.sum(0) * np.arange(frame.shape[1])).sum() / weight.sum()


def test_pendulum_resets_alike_from_a_seed(pendulum):
    first, again, other = (pendulum.reset(3, generator(seed)) for seed in (1, 1, 2))
    assert torch.equal(first.state, again.state)
    assert torch.equal(first.frame, again.frame)
    assert not torch.equal(first.state, other.state)
    assert bool(first.alive.all())
    moves = [pendulum.reset(3, generator(1)) and pendulum.step(torch.full((3, 1), 0.3)).state for _ in range(2)]
    assert torch.equal(*moves)


def test_pendulum_signs_in_state_and_picture(pendulum):
    left, middle, right, leaning = pendulum.show(
        np.array([[-0.5, 0, 0, 0], [0, 0, 0, 0], [0.5, 0, 0, 0], [0, 0, 0.2, 0]])
    )
    assert centre(left) + 20 < centre(middle) < centre(right) - 20
    top = slice(None, 60)  # the pole alone
    assert centre(leaning[top]) > centre(middle[top]) + 2
    before = pendulum.reset(1, generator())
    after = pendulum.step(torch.ones(1, 1))
    assert after.state[0, 1] > before.state[0, 1] + 0.1  # a positive command pushes towards +x
    assert after.state[0, 3] < before.state[0, 3]  # and leaves the pole behind


def test_pendulum_is_near_its_source_model(pendulum):
    from visadapt.targets.inverted_pendulum import SOURCE

    assert isinstance(SOURCE, CartPole)
    world = World(SOURCE, period=pendulum.period)
    before = pendulum.reset(8, generator(3))
    action = torch.linspace(-0.3, 0.3, 8)[:, None]
    after, expected = pendulum.step(action).state, world.step(world.start(before.state), action).state
    moved = (after - before.state).square().mean(0).sqrt()
    assert ((after - expected).square().mean(0).sqrt() < 0.4 * moved).all()
    # The published masses are those of the model that runs.
    body = pendulum._envs[0].unwrapped.model
    np.testing.assert_allclose(body.body_mass[1:], [float(SOURCE.cart_mass), float(SOURCE.pole_mass)])
    assert body.body_ipos[2][2] == pytest.approx(SOURCE.pole_half_length)
    assert body.actuator_gear[0, 0] == pytest.approx(SOURCE.max_force)


def test_pendulums_of_two_targets_do_not_draw_into_each_other(pendulum):
    from visadapt.targets.inverted_pendulum import MAP

    options = {**MAP.options, "width": 480, "height": 400}
    large = dataclasses.replace(MAP, options=options, crop=(0, 0, 480, 400))
    other = GymnasiumTarget("InvertedPendulum-v5", large)

    def frames(target):
        return target.reset(2, generator()).frame.float()

    alone, finer = frames(pendulum), frames(other)
    assert torch.equal(frames(pendulum), alone)
    assert torch.equal(frames(other), finer)
    other.close()
    assert torch.equal(frames(pendulum), alone)
    assert 0 < (alone - finer).abs().mean() < 1 < alone.mean()


def test_with_the_euler_integrator_a_frame_is_that_of_the_state_beside_it(pendulum):
    options = pendulum._envs[0].unwrapped.model.opt
    kept, options.integrator = options.integrator, 0
    pendulum.reset(1, generator())
    for _ in range(5):
        seen = pendulum.step(torch.full((1, 1), 0.6))
    options.integrator = kept
    assert seen.state[0, 1] > 0.4
    assert (pendulum.show(seen.state.numpy())[0] == seen.frame[0].numpy()).mean() > 0.999


def test_pendulum_keeps_its_own_reset_and_leaves_nothing_at_exit(pendulum):
    script = (
        "import dataclasses, torch, visadapt\n"
        "from visadapt.targets.inverted_pendulum import MAP\n"
        "target = visadapt.GymnasiumTarget('InvertedPendulum-v5', dataclasses.replace(MAP, start=None))\n"
        "print(target.reset(2, torch.Generator()).state.abs().max() <= 0.01)\n"
    )
    root = Path(__file__).parents[2]
    env = {**os.environ, "PYTHONPATH": str(root)}
    done = subprocess.run([sys.executable, "-c", script], env=env, capture_output=True, text=True, cwd=root)
    assert done.stdout.strip() == "tensor(True)"
    assert done.stderr == ""
