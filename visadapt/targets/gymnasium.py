"""Any gymnasium environment with continuous actions and `render_mode="rgb_array"` as a target."""

from __future__ import annotations

import atexit
import os
import traceback
import warnings
import weakref
from collections.abc import Callable
from numbers import Real
from typing import Any, NamedTuple

import gymnasium
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from visadapt.systems import CartPole, System
from visadapt.targets import mujoco_frames
from visadapt.targets.base import Observation, Target, TargetError
from visadapt.targets.env_map import EnvMap

RETURNED = {"reset": ("observation", "info"), "step": ("observation", "reward", "terminated", "truncated", "info")}
"""What these methods of an environment return."""

CALLED = {"reset": "reset(self, *, seed=None, options=None)", "step": "step(self, action)"}
"""How they are defined."""

STEP_TOLERANCE = 0.01  # Part of a step by which a period may differ from a whole number of them


class _Shown(NamedTuple):
    """What one environment shows."""

    state: NDArray[np.floating]
    """(n_state,)"""
    alive: bool
    picture: NDArray[np.uint8] | None
    """(H, W)"""


class GymnasiumTarget(Target):
    """A batch of environments of one kind, created when first needed and kept for later resets.

    Args:
        env: the environment's id, or a function that makes one (with `render_mode="rgb_array"` and no time limit).
        mapping: the map between its numbers and frames and ours; `mapping.options` are for gymnasium.make alone.
            Without `mapping.period` the period is the environment's `tau` or `dt`, or else 1 / `render_fps` of its
            metadata, with a warning, since that may be the playback speed of its films alone. If `mapping.period` is
            several of these, each action is held for that many steps.
            `mapping.start` works only with environments that `show` can put into a state.
        system: the system whose states and actions the mapping gives.
        frames: whether frames are drawn.

    Raises:
        TargetError: the environment cannot be made, has discrete actions, no rgb_array, or no period; the given period
            is no whole number of its steps; or the mapping does not fit it.

    >>> import torch, visadapt as va
    >>> from visadapt.targets.inverted_pendulum import MAP
    >>> target = va.GymnasiumTarget("InvertedPendulum-v5", MAP, frames=False)
    >>> target.reset(2, torch.Generator().manual_seed(0)).state.shape, target.period
    (torch.Size([2, 4]), 0.04)
    """

    def __init__(
        self,
        env: str | Callable[[], Any],
        mapping: EnvMap,
        system: type[System] = CartPole,
        frames: bool = True,
        name: str | None = None,
    ) -> None:
        if mapping.options and not isinstance(env, str):
            raise TargetError(
                f"{name or env}: the map's options are for gymnasium.make, but a function makes this environment: "
                "leave them out"
            )
        mujoco_frames.choose_backend()
        self._given_env = env
        self.mapping = mapping
        self.system: type[System] = system
        self.frames = frames
        self.name = name or str(env)
        first = self._make()
        self.name = name or (first.spec.id if first.spec is not None else type(first.unwrapped).__name__)
        self.n_action = len(mapping.actions)
        self._n_env_action = self._check(first)
        own_step = _own_step(first, mapping.period)
        self.period, self.period_origin = self._period(first, own_step)
        self.held = _whole_steps(self.period, own_step[1]) if own_step else 1
        """steps of the environment for which each action is held"""
        self._mujoco = frames and mujoco_frames.is_mujoco(first)
        if self._mujoco:
            mujoco_frames.check_rendering(self.name)
        self._envs = [first]
        self._closed_at_exit = False
        self._steps = 0
        self._shown: list[_Shown] = []

    def reset(self, batch: int, generator: torch.Generator) -> Observation:
        """Start `batch` new episodes, each environment seeded from the generator; raises TargetError as `step` does."""
        seeds = torch.randint(2**31 - 1, (batch,), generator=generator).tolist()
        starts: NDArray[np.floating] | None = None
        if self.mapping.start is not None:
            widths = torch.tensor([self.mapping.start.get(variable.name, 0.0) for variable in self.system.states])
            starts = (widths * (2 * torch.rand(batch, len(widths), generator=generator) - 1)).double().numpy()
        while len(self._envs) < batch:
            self._envs.append(self._make())
        if self._mujoco:
            mujoco_frames.share_viewer(self._envs)
        self._steps, self._shown = 0, []
        for b, env in enumerate(self._envs[:batch]):
            seen, _ = self._call(env, "reset", seed=seeds[b])
            if starts is not None:
                seen = self._put_into(env, seen, starts[b])
            self._shown.append(self._see(seen, b))
        return self._observe()

    def step(self, action: Tensor) -> Observation:
        """Execute the action (B, n_action) for one period; an episode that has ended stays as it was.

        Raises:
            TargetError: step before reset, an action of another shape or not finite, an environment that raises, an
                observation that is not finite or does not fit its space, a frame that the crop does not fit, or an
                episode that the environment truncates.
        """
        batch = len(self._shown)
        if action.shape != (batch, self.n_action) or not batch:
            wanted = f"({batch}, {self.n_action})" if batch else "a reset first"
            raise TargetError(f"{self.name}: step with an action of shape {tuple(action.shape)}; it needs {wanted}")
        if not bool(action.isfinite().all()):
            raise TargetError(f"{self.name}: the action of step {self._steps} is not finite")
        self._steps += 1
        commands = self.system.within_range(action.detach()).double().cpu().numpy()
        for b, env in enumerate(self._envs[:batch]):
            if not self._shown[b].alive:
                continue
            env_action = self.mapping.action(commands[b], self._n_env_action)
            for _ in range(self.held):
                seen, _, terminated, truncated, _ = self._call(env, "step", env_action.astype(env.action_space.dtype))
                if terminated or truncated:
                    break
            if truncated and not terminated:
                raise TargetError(
                    f"{self.name}: cut the episode short after {self._steps} steps; make it without a time limit "
                    "(gymnasium.make(..., max_episode_steps=-1), or let its step return truncated False)"
                )
            self._shown[b] = self._see(seen, b, terminated)
        return self._observe()

    def close(self) -> None:
        """Free the environments and their renderers; the target cannot be used afterwards."""
        envs, self._envs, self._shown = self._envs, [], []
        if envs and self._mujoco:
            mujoco_frames.close_all(envs)
        else:
            for env in envs:
                env.close()

    def show(self, states: NDArray[np.floating]) -> NDArray[np.uint8]:
        """Frames (N, H, W) uint8 of chosen states (N, n_state), to train a renderer; takes no step of the target.

        Raises:
            TargetError: this environment cannot be put into a state: it is neither one of MuJoCo's whose observation
                is all positions, then all velocities, nor one that keeps what it observes as `unwrapped.state`.
        """
        seen, _ = self._call(self._envs[0], "reset", seed=0)
        pictures = []
        for state in states:
            seen = self._put_into(self._envs[0], seen, state)
            pictures.append(self._draw(self._envs[0]))
        return np.stack(pictures)

    def _make(self) -> Any:
        if not isinstance(self._given_env, str):
            return self._given_env()
        try:
            # No time limit: episodes end where the mapping's limits or the environment say.
            return gymnasium.make(
                self._given_env,
                render_mode="rgb_array" if self.frames else None,
                max_episode_steps=-1,
                disable_env_checker=True,
                **self.mapping.options,
            )
        except Exception as error:  # whatever the environment's constructor raises becomes one line
            if isinstance(error, gymnasium.error.DependencyNotInstalled) and "mujoco" in str(error).lower():
                raise TargetError(f"{self.name}: mujoco is not installed: pip install 'visadapt[mujoco]'") from error
            # Importing mujoco fails in many ways if MUJOCO_GL names a missing library.
            if "/mujoco/__init__.py" in "".join(traceback.format_tb(error.__traceback__)).replace(os.sep, "/"):
                raise mujoco_frames.cannot_render(self.name, error) from error
            raise TargetError(f"{self.name}: cannot be made: {_first_line(error)}") from error

    def _call(self, env: Any, method: str, *arguments: object, **named: object) -> tuple[Any, ...]:
        """What the environment's `reset` or `step` returns, with the observation in floating point."""
        try:
            returned = getattr(env, method)(*arguments, **named)
        except Exception as error:  # whatever the environment raises becomes one line
            last = traceback.extract_tb(error.__traceback__)[-1]
            place = f"({last.filename}, line {last.lineno})"
            if last.filename == __file__:  # it does not take what it is given
                place = f"(def {CALLED[method]} is right)"
            raise TargetError(
                f"{self.name}: {method}() failed: {type(error).__name__}: {_first_line(error)} {place}"
            ) from error
        right = RETURNED[method]
        if not isinstance(returned, tuple) or len(returned) != len(right):
            got = f"{len(returned)} values" if isinstance(returned, tuple) else f"a {type(returned).__name__}"
            raise TargetError(f"{self.name}: {method}() returned {got}; {', '.join(right)} are right")
        seen, shape = np.asarray(returned[0]), env.observation_space.shape
        if seen.shape != shape:
            raise TargetError(
                f"{self.name}: {method}() returned an observation of shape {seen.shape}; its observation_space says "
                f"{shape}"
            )
        return seen.astype(float), *returned[1:]

    def _check(self, env: Any) -> int:
        """The length of the environment's action; raises TargetError where it cannot be a target."""
        box = gymnasium.spaces.Box
        if not isinstance(env.action_space, box) or len(env.action_space.shape) != 1:
            raise TargetError(
                f"{self.name}: its actions are {env.action_space}, but policies command real numbers: "
                "take an environment whose action space is a one-dimensional Box, such as InvertedPendulum-v5"
            )
        if not isinstance(env.observation_space, box) or len(env.observation_space.shape) != 1:
            raise TargetError(
                f"{self.name}: its observations are {env.observation_space}; a one-dimensional Box is needed"
            )
        modes = env.metadata.get("render_modes", [])
        if self.frames and (env.render_mode != "rgb_array" or "rgb_array" not in modes):
            raise TargetError(
                f"{self.name}: its render_mode is {env.render_mode!r} (it has {', '.join(modes) or 'none'}); "
                'frames need one made with render_mode="rgb_array"'
            )
        n_action = int(env.action_space.shape[0])
        self.mapping.check(self.name, self.system, int(env.observation_space.shape[0]), n_action)
        self.mapping.check_range(self.name, self.system, env.action_space.low, env.action_space.high)
        return n_action

    def _period(self, env: Any, own_step: tuple[str, float] | None) -> tuple[float, str]:
        """s between actions, and where that number comes from; `own_step` is that of `_own_step`."""
        given, rate = self.mapping.period, env.metadata.get("render_fps")
        if given is not None:
            # No environment is stepped for a part of its step.
            if own_step and not _whole_steps(given, own_step[1]):
                raise TargetError(
                    f"{self.name}: its {own_step[0]} says {own_step[1]:g} s a step, so that the period given, "
                    f"{given:g} s, is no whole number of steps"
                )
            return float(given), "as given"
        if own_step:
            return own_step[1], f"its {own_step[0]}"
        if not rate:
            raise TargetError(
                f"{self.name}: the environment states no step length (tau, dt or render_fps); give `period` in s"
            )
        origin = f"render_fps = {rate:g} of its metadata, which may be the speed of a film alone: give `period` in s"
        warnings.warn(f"{self.name}: the period, {1 / rate:g} s, is taken from {origin}", stacklevel=3)
        return 1 / float(rate), origin

    def _put_into(self, env: Any, seen: NDArray[np.floating], state: NDArray[np.floating]) -> NDArray[np.floating]:
        """Put an environment that observes `seen` and has not been stepped into our state; its observation there."""
        wanted = self.mapping.observation(state, self.system, seen)
        body = env.unwrapped
        n_position = getattr(getattr(body, "model", None), "nq", None)
        if n_position is not None and hasattr(body, "set_state") and len(seen) == n_position + body.model.nv:
            body.set_state(wanted[:n_position], wanted[n_position:])
            got = np.asarray(body._get_obs())
            if not np.allclose(got, wanted, atol=1e-6):
                raise TargetError(f"{self.name}: put into the observation {wanted}, it shows {got}")
            return got
        kept = np.asarray(getattr(body, "state", None))
        if kept.shape != seen.shape or not np.allclose(kept.astype(float), seen, atol=1e-6):
            raise TargetError(
                f"{self.name}: cannot be put into a state: its observation is neither positions, velocities of a "
                "MuJoCo model nor what it keeps as `unwrapped.state`"
            )
        body.state = wanted.astype(kept.dtype)
        return wanted

    def _see(self, seen: NDArray[np.floating], episode: int, ended: bool = False) -> _Shown:
        """What an environment that observes `seen` shows."""
        broken = np.flatnonzero(~np.isfinite(seen))
        if len(broken):
            raise TargetError(
                f"{self.name}: observation entry {broken[0]} is {seen[broken[0]]} after step {self._steps} "
                f"(episode {episode}); the environment must stay finite until it ends the episode"
            )
        state = self.mapping.state(seen, self.system)
        limits = self.mapping.limits.items()
        inside = all(abs(state[self.system.index(name)]) <= limit for name, limit in limits)
        return _Shown(state, not ended and inside, self._draw(self._envs[episode]) if self.frames else None)

    def _draw(self, env: Any) -> NDArray[np.uint8]:
        try:
            if self._mujoco:
                mujoco_frames.aim_viewer(env)
            picture = env.render()
        except Exception as error:  # whatever the renderer raises becomes one line
            if self._mujoco:
                raise mujoco_frames.cannot_render(self.name, error) from error
            raise TargetError(f"{self.name}: render() failed: {_first_line(error)}") from error
        if not self._closed_at_exit:
            # Registered after the first frame, so that it runs before the exit functions that the renderer registered
            # while drawing: a viewer that is freed later than its display prints tracebacks.
            atexit.register(_close, weakref.ref(self))
            self._closed_at_exit = True
        return self.mapping.frame(self.name, picture)

    def _observe(self) -> Observation:
        states, alive, pictures = zip(*self._shown, strict=True)
        return Observation(
            state=torch.tensor(np.stack(states), dtype=torch.get_default_dtype()),
            alive=torch.tensor(alive),
            frame=torch.from_numpy(np.stack(pictures)) if self.frames else None,
        )


def _own_step(env: Any, period: float | None) -> tuple[str, float] | None:
    """What an environment calls the length of its step, and that length in s; None where it states none.

    Of one that states both, the longest of which the period is a whole number: the other may be a motor's time
    constant or the step of its physics. A wrapper that repeats actions may state its own.
    """
    values = {name: env.get_wrapper_attr(name) for name in ("tau", "dt") if env.has_wrapper_attr(name)}
    stated = [(name, float(value)) for name, value in values.items() if isinstance(value, Real) and float(value) > 0]
    fitting = [each for each in stated if period is not None and _whole_steps(period, each[1])]
    return max(fitting or stated[:1], key=lambda each: each[1], default=None)


def _whole_steps(period: float, step: float) -> int:
    """How many steps, of `step` s each, make up a period in s; 0 where that is no whole number."""
    count = round(period / step)
    return count if abs(period / step - count) <= STEP_TOLERANCE else 0


def _close(target: weakref.ref[GymnasiumTarget]) -> None:
    if (alive := target()) is not None:
        alive.close()


def _first_line(error: BaseException) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0]
