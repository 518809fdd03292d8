"""States from frames alone: poses by the learnt renderer, velocities by a smoother over the source physics.

What the source leaves out is an unknown load d (a force on the cart, a torque at the pivot), constant over a period
and drifting from one to the next, and shocks e to the cart that come and go within one (a command that acts late):

    s_{t+1} = f(s_t, a_t; d_t) + q_e e_t    f the source physics; e the force of white noise on the cart, integrated
    d_{t+1} = d_t + q w_t                   w white; an intensity q for each load
    y_t     = (x_t, theta_t) + c v_t        v_t ~ N(0, R_t), R_t from the fit of the renderer to frame t

The one-step gap of the smoothed states, s_{t+1} - f(s_t, a_t), is the effect of the smoothed load and shock, and
grounding learns from it. q, q_e and c maximise the likelihood (Schweppe 1965, IEEE Trans. Inf. Theory 11(1)) times a
wide prior, which decides where an episode is too short. A change of load within a period is seen in the positions
alone, so its effect on the velocities stays uncertain. The smoother is the extended Kalman filter and the recursion of
Bryson and Frazier (1963), run again around its own result: the Gauss-Newton iteration for the most probable path (Bell
1994, SIAM J. Optim. 4(3)).
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor, nn

from visadapt.effects.camera import CameraEffect
from visadapt.estimation.camera_fit import SeenBy, within_frame
from visadapt.estimation.kalman import Linear, backward
from visadapt.estimation.linearise import linearise_step, load_effect
from visadapt.estimation.noise import Noise, UnknownNoise, most_probable_noise
from visadapt.estimation.poses import HIDDEN, PoseFinder, Poses, reach_of
from visadapt.recordings import Episode
from visadapt.recordings.runs import runs
from visadapt.world import World

SHOCK = 0.03
"""m/s2, the unit of shocks: they are expected to be smaller than what a load drifts by in a period (unit 1 m/s2)."""

SMOOTHINGS, NOISE_FITS = 4, 2
"""Times that the physics are linearised around the path so far; in so many of them, the first, the noise is fitted."""

PERIOD_TOLERANCE = 0.01  # Share of the source's period by which two rows may be further apart, or closer

ACCELERATION = 10.0  # m/s2 and rad/s2, standard deviation of the acceleration by a load before any frame is seen

BRIDGED = 10
"""Most consecutive rows without a usable frame: about upright, errors grow by a factor e in about 5 rows."""


class TrackingError(ValueError):
    """Frames from which no states can be estimated; the message is one line."""


class TrackingWarning(UserWarning):
    """Some frames were left out: the renderer does not explain them."""


class Tracker:
    """Estimates states from frames; the grid of rendered poses is made once, for all episodes.

    Args:
        renderer: learnt, of x (B,) in m and theta (B,) in rad to frames (B, H, W) in [0, 1].
        world: the source physics, without effects; the cart is looked for within the range of its system's table, or
            as far as the renderer shows it.
        camera: known faults of the camera, through which the renderer's pictures are seen.

    Raises:
        TrackingError: a world with effects, which would hide the gap that is looked for.
    """

    def __init__(self, renderer: nn.Module, world: World, camera: Sequence[CameraEffect] = ()) -> None:
        if len(world.effects):
            raise TrackingError(f"tracking needs the source physics alone, not {len(world.effects)} effects")
        system = world.system
        self.world = world
        self._pose_columns = [system.index("x"), system.index("theta")]
        self._rate_columns = [system.index("x_dot"), system.index("theta_dot")]
        load = load_effect(type(system))
        no_load = load(**{parameter.name: 0.0 for parameter in load.table})
        self._loaded_world = world.with_effects((no_load,))
        """the world with an effect whose values are the loads, for derivatives by these"""
        self._late_effects = [effect.name for effect in camera if not effect.in_one_frame]
        camera = [effect for effect in camera if effect.in_one_frame]
        self.poses = PoseFinder(SeenBy(renderer, camera) if camera else renderer, reach_of(renderer, system))
        self._drawn = within_frame(camera, torch.zeros(self.poses.size)).to(torch.uint8)
        """(H, W) 1 where the renderer draws what is seen, else 0"""

    def track(self, episodes: Sequence[Episode]) -> list[Episode]:
        """The episodes with states estimated from their frames and actions alone; one noise model is fitted to all.

        Raises:
            TrackingError: an episode without frames, with frames of another size or a clock of another period, or
                whose frames the renderer does not explain, most of them or more than `BRIDGED` in a row; or a camera
                that is known to be late or to lose frames.

        One or two rows cannot tell a load from a velocity: in so short an episode the estimated gap is 0.
        """
        if self._late_effects:
            raise TrackingError(
                f"states are not estimated from frames with {' and '.join(self._late_effects)}: they would be of other "
                "rows; without a residual (--diagnose) none are needed"
            )
        if not episodes:
            return []
        poses = [self._poses(number, episode) for number, episode in enumerate(episodes)]
        commands = [torch.as_tensor(episode.action[:-1], dtype=torch.float64) for episode in episodes]
        paths = [self._first_guess(each) for each in poses]
        noise: Noise | None = None
        for pass_number in range(SMOOTHINGS):
            problems = [self._problem(*parts) for parts in zip(poses, commands, paths, strict=True)]
            if pass_number < NOISE_FITS:
                noise = most_probable_noise(problems, noise)
            assert noise is not None
            paths = [backward(each.filtered(noise))[0][0, ..., 0] for each in problems]
        states = len(self.world.system.states)
        return [
            replace(episode, state=path[:, :states].numpy().astype(episode.action.dtype))
            for episode, path in zip(episodes, paths, strict=True)
        ]

    def label(self, episodes: Sequence[Episode]) -> list[Episode]:
        """The same episodes with states estimated from their frames; those of 1 or 2 rows are left out."""
        return self.track([episode for episode in episodes if len(episode.time) > 2])

    def _poses(self, number: int, episode: Episode) -> Poses:
        """The poses that the frames of an episode show; raises TrackingError as `track`."""
        if episode.frame is None:
            raise TrackingError(f"episode {number} has no frames to estimate states from")
        height, width = self.poses.size
        if episode.frame.shape[1:] != (height, width):
            raise TrackingError(
                f"episode {number} has frames of {episode.frame.shape[1]} x {episode.frame.shape[2]} "
                f"(height x width); the renderer draws {height} x {width}"
            )
        periods = np.diff(episode.time)
        if len(periods) and np.abs(periods - self.world.period).max() > PERIOD_TOLERANCE * self.world.period:
            worst = float(periods[np.abs(periods - self.world.period).argmax()])
            raise TrackingError(f"episode {number} has rows {worst:g} s apart; the period is {self.world.period:g} s")
        poses = self.poses(self._drawn * torch.from_numpy(np.ascontiguousarray(episode.frame)))
        missed = (~poses.explained).nonzero()[:, 0]
        if len(missed):
            first = int(missed[0])
            differs = 100 * float(poses.contrast[first])
            line = (
                f"episode {number}: the renderer does not explain {len(missed)} of {len(poses.contrast)} frames, row "
                f"{first} the first (where it draws cart and pole, they differ by {differs:.0f} % of the contrast, "
                f"at most {100 * HIDDEN:.0f} % is right)"
            )
            longest = max(end - start for start, end in runs(poses.explained.numpy()) if not poses.explained[start])
            if 2 * len(missed) > len(poses.contrast) or longest > BRIDGED:
                raise TrackingError(line)
            warnings.warn(f"{line}; they were left out", TrackingWarning, stacklevel=3)
        return poses

    def _first_guess(self, poses: Poses) -> Tensor:
        """States and loads (T, n_state + n_load): poses as seen, velocities by differences, no load."""
        system, rows = self.world.system, np.arange(len(poses.pose))
        used = poses.explained.numpy()
        seen = np.stack([np.interp(rows, rows[used], column[used]) for column in poses.pose.numpy().T], 1)
        guess = torch.zeros(len(rows), len(system.states) + len(system.loads), dtype=torch.float64)
        guess[:, self._pose_columns] = torch.from_numpy(seen)
        if len(rows) > 1:
            guess[:, self._rate_columns] = torch.from_numpy(np.gradient(seen, axis=0) / self.world.period)
        return guess

    def _problem(self, poses: Poses, command: Tensor, path: Tensor) -> UnknownNoise:
        """The physics linearised along the path (T, n_state + n_load); readings scaled to unit variance."""
        states, n = len(self.world.system.states), path.shape[1]
        before = path[:-1]
        acting = self.world.system.within_range(command)[:, None].expand(-1, self.world.substeps, -1)
        tangent = linearise_step(
            self._loaded_world, before[:, states:], torch.zeros(len(before)).to(path), before[:, :states], acting
        )
        transition = torch.eye(n, dtype=path.dtype).repeat(len(before), 1, 1)
        transition[:, :states] = torch.cat((tangent.by_state, tangent.by_parameter), 2)
        after = torch.cat((tangent.value, before[:, states:]), 1)
        offset = after - (transition @ before[..., None])[..., 0]
        unit_loads, drift = self._drifts()
        half_ranges = torch.tensor([(v.high - v.low) / 2 for v in self.world.system.states], dtype=path.dtype)
        used = poses.explained[:, None].to(path)
        sensing = used[..., None] * torch.eye(n, dtype=path.dtype)[self._pose_columns]
        reading = used * poses.pose.nan_to_num()
        root = torch.linalg.cholesky(torch.where(used[..., None] > 0, poses.covariance, torch.eye(2).to(path)))
        linear = Linear(
            transition=transition[None],
            drive=offset[None, ..., None],
            sensing=torch.linalg.solve_triangular(root, sensing, upper=False)[None],
            reading=torch.linalg.solve_triangular(root, reading[..., None], upper=False)[None],
            start=path.new_zeros(1, n, 1),
            initial_variance=torch.cat((half_ranges, ACCELERATION * unit_loads)).square()[None],
        )
        return UnknownNoise(linear, used.expand(-1, len(self._pose_columns))[None], drift)

    def _drifts(self) -> tuple[Tensor, Tensor]:
        """Unit loads (n_load,), in N and N m: each accelerates its own body at upright rest by 1 m/s2 or 1 rad/s2.

        And the covariances (n_load + 1, n_state + n_load, n_state + n_load) of the change of state and load in a
        period: for each load, of a drift by its unit; last, of shocks of `SHOCK` on average over the period.
        """
        system, h = self.world.system, self.world.period
        states, loads = len(system.states), len(system.loads)
        rest = torch.zeros(loads, states, dtype=torch.float64)
        no_command = torch.zeros(loads, len(system.actions), dtype=torch.float64)
        one_each = torch.eye(loads, dtype=torch.float64)  # 1 N or 1 N m, one load at a time
        change = system.derivative(rest, no_command, one_each) - system.derivative(rest, no_command, 0 * one_each)
        unit = 1 / change[:, self._rate_columns].diagonal().abs()
        drift = torch.zeros(loads + 1, states + loads, states + loads, dtype=torch.float64)
        for k in range(loads):
            drift[k, states + k, states + k] = unit[k].square()
        # Velocity and position after white acceleration of variance 1 / h (Bar-Shalom, Li and Kirubarajan 2001, section
        # 6.2.2): their common part, and the part of the position that depends on when in the period it came.
        acceleration = SHOCK * unit[0] * change[0, self._rate_columns]
        common, late = torch.zeros(2, states + loads, dtype=torch.float64)
        common[self._rate_columns] = acceleration * h
        common[self._pose_columns] = acceleration * h**2 / 2
        late[self._pose_columns] = acceleration * h**2 / 12**0.5
        drift[-1] = common.outer(common) + late.outer(late)
        return unit, drift
