"""Real files, as small as they can be, for the tests of the command."""

import numpy as np

from renderers import Camera, DrawnCartPole
from visadapt.cli import main as cli
from visadapt.recordings import Episode, write_recording

CAMERA = Camera(width=48, height=40, scale=16.0, column=23.5, row=29.5)
GUESS = ("--hinge", "22,28.5", "--scale", "15.2", "--pole", "1.1")

RIG = """
import gymnasium
import numpy as np

import visadapt as va
from renderers import Camera, DrawnCartPole

CAMERA = Camera(width=48, height=40, scale=16.0, column=23.5, row=29.5)
not_callable = 3


def states():
    return va.SyntheticTarget(va.constant_force(1.0))


def filmed():
    return va.SyntheticTarget(va.constant_force(1.0), DrawnCartPole(CAMERA))


def larger():
    return va.SyntheticTarget(va.constant_force(1.0), DrawnCartPole(Camera(width=60, height=50)))


def slow():
    return va.SyntheticTarget(period=0.1)


def timeless():
    target = Bare()
    target.period = "50 ms"
    return target


def flying():
    return va.FlightTarget(va.setup_for(va.World(va.FixedWing())).settings.source.task, va.FixedWing())


def broken():
    raise RuntimeError("the motor is off")


def needy(speed, *rest, again=2):
    return "a robot"


def nonsense():
    return "a robot"


class Turned(va.SyntheticTarget):
    def step(self, action):
        return super().step(-action)


def turned():
    return Turned()


class Bare(va.Target):
    \"\"\"A target that sets no more than a target must.\"\"\"

    name, period, n_action = "bare", 0.05, 1

    def __init__(self):
        self.inner = states()

    def reset(self, batch, generator):
        return self.shown(self.inner.reset(batch, generator))

    def step(self, action):
        return self.shown(self.inner.step(action))

    def shown(self, seen):
        return va.Observation(seen.state, seen.alive)


def bare():
    return Bare()


class Pushed(gymnasium.ActionWrapper):
    \"\"\"gymnasium's own cart-pole, whose action is a force here and drawn by us: its picture needs pygame.\"\"\"

    def __init__(self):
        super().__init__(gymnasium.make("CartPole-v1", max_episode_steps=-1))
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,))
        self.metadata = {"render_modes": ["rgb_array"], "render_fps": 50}

    @property
    def render_mode(self):
        return "rgb_array"

    def action(self, action):
        self.unwrapped.force_mag = 10.0 * abs(float(action[0]))
        return int(action[0] > 0)

    def render(self):
        x, _, theta, _ = np.array(self.unwrapped.state)[:, None]
        return np.repeat(DrawnCartPole(CAMERA)(x, theta)[0][..., None], 3, 2)


def pushed():
    return Pushed()
"""

MAP = """
actions = [{ index = 0 }]
height = 40
[states]
x = { index = 0 }
x_dot = { index = 1 }
theta = { index = 2 }
theta_dot = { index = 3 }
[start]
x = 0.1
theta = 0.05
"""


def run(*arguments):
    """The exit status of the command."""
    return cli.main([str(argument) for argument in arguments])


def refused(capsys, *arguments):
    """The one line in which the command refuses bad input."""
    capsys.readouterr()
    assert run(*arguments) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    *_, line = printed.err.splitlines()
    assert line.startswith("visadapt: ")
    return line


def write_frames(path, count=120, camera=CAMERA, names=None):
    """A recording of frames at scattered states."""
    rng = np.random.default_rng(0)
    state = rng.uniform(-1, 1, (count, 4)) * [1.0, 0, 0.35, 0]
    frame = DrawnCartPole(camera)(state[:, 0], state[:, 2])
    episode = Episode(0.05 * np.arange(count), np.zeros((count, 1)), state, frame)
    write_recording(path, [episode], names)
    return path
