"""Many machines at once, as stable-baselines3 wants them."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import torch
from stable_baselines3.common.vec_env import VecEnv
from torch import Tensor

from benchmarks.baselines.courses import Course
from visadapt.history import History
from visadapt.targets.synthetic import DrawEffects, fine_world
from visadapt.world import World, WorldState

MACHINES = 64


class Machines(VecEnv):
    """A batch of machines on a course, each started anew when its episode ends.

    Args:
        course: starts, what is shown, rewards and ends.
        draw_effects: of a batch of episodes.
        source: the world that they are integrated as; None: as finely as the target.
        seed: of starts and effects.
    """

    def __init__(self, course: Course, draw_effects: DrawEffects, source: World | None, seed: int) -> None:
        self.course, self.draw_effects, self.source = course, draw_effects, source
        self.n_action = len(course.system.actions)
        self.generator = torch.Generator().manual_seed(seed)
        state, task_state = course.start(1, torch.Generator().manual_seed(seed))
        width = course.shown(History.start(course.observed(state, task_state), self.n_action)).shape[1]
        boxes = [
            gymnasium.spaces.Box(-limit, limit, (size,)) for limit, size in ((np.inf, width), (1.0, self.n_action))
        ]
        super().__init__(MACHINES, *boxes)

    def reset(self) -> np.ndarray:
        self.effects = self.draw_effects(MACHINES, self.generator)
        if self.source is None:
            self.world = fine_world(self.course.system, self.effects, self.course.period)
        else:
            self.world = self.source.with_effects(self.effects).requires_grad_(False)
        self.at, self.task_state, self.history = self._begun()
        self.age = torch.zeros(MACHINES, dtype=torch.long)
        return self.course.shown(self.history).numpy()

    def step_async(self, actions: np.ndarray) -> None:
        self.action = torch.as_tensor(actions, dtype=torch.float32).clamp(-1, 1)

    @torch.no_grad()
    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        before = self.at.state
        self.at = self.world.step(self.at, self.action)
        self.task_state = self.course.advance(self.task_state)
        seen, self.at = self.world.measure(self.at, self.generator)
        self.history = self.history.acting(self.action).observing(self.course.observed(seen, self.task_state))
        self.age += 1
        reward, failed, over = self.course.judge(before, self.action, self.at.state, self.task_state)
        failed = failed | ~self.at.state.isfinite().all(1)
        reward = torch.where(failed, torch.zeros_like(reward), reward)
        late = self.age >= self.course.steps
        ended = failed | over | late
        last, infos = self.course.shown(self.history).numpy(), [dict[str, Any]() for _ in range(MACHINES)]
        for row in ended.nonzero()[:, 0].tolist():
            truncated = bool(late[row]) and not bool(failed[row] | over[row])
            infos[row] = {"terminal_observation": last[row], "TimeLimit.truncated": truncated}
        if bool(ended.any()):
            self._restart(ended.nonzero()[:, 0])
        return self.course.shown(self.history).numpy(), reward.numpy(), ended.numpy(), infos

    def _begun(self) -> tuple[WorldState, Tensor, History]:
        state, task_state = self.course.start(MACHINES, self.generator)
        seen, at = self.world.measure(self.world.start(state), self.generator)
        return at, task_state, History.start(self.course.observed(seen, task_state), self.n_action)

    def _restart(self, rows: Tensor) -> None:
        """New episodes, with effects drawn anew, in these rows."""
        for effect, fresh in zip(self.effects, self.draw_effects(MACHINES, self.generator), strict=True):
            for parameter in effect.table:
                values = getattr(effect, parameter.name)
                if values.dim():
                    values.data[rows] = getattr(fresh, parameter.name).data[rows]
        at, task_state, history = self._begun()
        self.at, self.history = self.at.replaced(rows, at[rows]), self.history.replaced(rows, history[rows])
        self.task_state = self.task_state.clone()
        self.task_state[rows] = task_state[rows]
        self.age[rows] = 0

    def close(self) -> None:
        pass

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        return [getattr(self, attr_name, None)] * self.num_envs

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        raise NotImplementedError

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        raise NotImplementedError

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        return [False] * self.num_envs
