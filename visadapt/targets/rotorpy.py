"""rotorpy's multirotor as a target: a quadrotor whose aerodynamics, motors and rate loop are not ours.

Folk, Paulos and Kumar (2023), RotorPy: a Python-based multirotor simulator with aerodynamics, arXiv:2306.04485. The
vehicle is its Crazyflie Brushless with propeller guards, unchanged, commanded by collective thrust and body rates
(`cmd_ctbr`). `SOURCE` is the model from its published mass, arm length and rate gain.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from visadapt.systems import Quadrotor
from visadapt.systems.rigid_body import ATTITUDE, POSITION, RATES, VELOCITY
from visadapt.targets.base import Observation, TargetError
from visadapt.targets.synthetic import FlightTarget
from visadapt.tasks.follow import Follow

RATE_LOOP_PERIOD_S = 0.01
"""s between runs of rotorpy's rate loop, its default; thrusts are held in between"""

SOURCE = Quadrotor(
    mass=0.044,
    arm_length=0.043,
    roll_gain=5.27,
    yaw_gain=5.27,
    max_rate=1.0,
    torque_to_thrust=7.8e-10 / 4.052e-8,
)
"""The source model from the vehicle's published parameters.

Thrusts are mass-normalised, so their range is the default's. The largest rate is twice the default's, since this rate
loop is a third as stiff. The inertia is that of a plate of this mass and arm length; it cancels in the rate loop.

Deliberately not modelled: rotor drag, the change of thrust with the air flow through and across the rotors, wind, the
motors' lag of 50 ms, the period of the rate loop, and the gyroscopic torque, for which rotorpy's rate loop does not
compensate.
"""


@dataclass(frozen=True)
class Air:
    """Wind in world axes: a constant velocity (rotorpy's ConstantWind) plus a sinusoidal one (its SinusoidWind).

    Phases of the sinusoids are drawn uniformly for every flight.
    """

    steady: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """m/s"""
    amplitude: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """m/s"""
    frequency: tuple[float, float, float] = (0.1, 0.15, 0.1)
    """Hz"""


BREEZE = Air(steady=(1.5, 0.0, 0.0), amplitude=(0.5, 1.0, 0.0))


class RotorpyTarget(FlightTarget):
    """A batch of rotorpy's multirotors along references, with rotor drag, motor lag and wind; 0.1 s between commands.

    Commands mean the same thrust in N and the same rates as the source's. States are rotorpy's in our order; its
    quaternion is (x, y, z, w). Rotors start at hover speed.

    Args:
        task: where flights start and the goals that policies are shown.
        air: the wind.
        aero: whether there are aerodynamic forces.
        changes: parameters that replace rotorpy's published ones, by rotorpy's names.

    Raises:
        TargetError: rotorpy, or a package that its batched multirotor needs, is not installed.
    """

    name = "rotorpy's Crazyflie Brushless"

    def __init__(
        self, task: Follow, air: Air = BREEZE, aero: bool = True, changes: Mapping[str, Any] | None = None
    ) -> None:
        super().__init__(task, SOURCE)
        self._physics = _import("rotorpy.vehicles.multirotor", "torchdiffeq", "roma")
        self._winds = _import("rotorpy.wind.default_winds")
        self.vehicle = {**_import("rotorpy.vehicles.crazyfliebrushless_params").quad_params, **(changes or {})}
        self.air = air
        self.aero = aero
        self._multirotors: Any = None
        self._profiles: list[Any] = []
        self._state: dict[str, Tensor] = {}
        self._steps = 0

    def reset(self, batch: int, generator: torch.Generator) -> Observation:
        state, self.first = self.task.evaluation_start(batch, generator)
        self._task_state = self.first
        state = state.double()
        hover_speed = (self.vehicle["mass"] * 9.81 / 4 / self.vehicle["k_eta"]) ** 0.5  # rad/s
        self._state = {
            "x": state[:, POSITION],
            "v": state[:, VELOCITY],
            "q": state[:, ATTITUDE].roll(-1, 1),
            "w": state[:, RATES],
            "rotor_speeds": state.new_full((batch, 4), hover_speed),
        }
        self._steps, self._profiles = 0, self._wind(batch, generator)
        self._set_wind()
        device = torch.device("cpu")
        parameters = self._physics.BatchedMultirotorParams([self.vehicle] * batch, batch, device)
        self._multirotors = self._physics.BatchedMultirotor(
            parameters, batch, self._state, device, "cmd_ctbr", self.aero, integrator="rk4"
        )
        return self._observe()

    def step(self, action: Tensor) -> Observation:
        if self._multirotors is None:
            raise TargetError(f"{self.name}: step before reset")
        command = action.detach().double().clamp(-1, 1)
        control = {
            "cmd_thrust": SOURCE.mass * SOURCE.thrust(command)[:, None],
            "cmd_w": SOURCE.max_rate * command[:, 1:],
        }
        with torch.no_grad():
            for _ in range(round(self.period / RATE_LOOP_PERIOD_S)):
                self._state = self._multirotors.step(self._state, control, RATE_LOOP_PERIOD_S)
                self._steps += 1
                self._set_wind()
        self._task_state = self.task.advance(self._task_state)
        return self._observe()

    def _wind(self, batch: int, generator: torch.Generator) -> list[Any]:
        """rotorpy's wind profiles, whose sum is the wind."""
        air = self.air
        amplitude, frequency = (torch.tensor([each] * batch).double() for each in (air.amplitude, air.frequency))
        delay = torch.rand(batch, 3, generator=generator, dtype=torch.double) / frequency
        return [
            self._winds.BatchedConstantWind(batch, *air.steady),
            self._winds.BatchedSinusoidWind(amplitude, frequency, delay),
        ]

    def _set_wind(self) -> None:
        """Set the wind for the next step of the rate loop."""
        time, position = self._steps * RATE_LOOP_PERIOD_S, self._state["x"]
        winds = (each.update(time, position) for each in self._profiles)
        self._state["wind"] = sum(winds, torch.zeros_like(position))

    def _observe(self) -> Observation:
        theirs = self._state
        ours = torch.cat((theirs["x"], theirs["v"], theirs["q"].roll(1, 1), theirs["w"]), 1)
        state = ours.to(torch.get_default_dtype())
        alive = state.isfinite().all(1)
        return Observation(state, alive, goal=self.task.goal(self._task_state), task_state=self._task_state)


def _import(module: str, *needs: str) -> Any:
    """A module of rotorpy; also imports the packages it `needs`, whose absence rotorpy itself does not report."""
    try:
        found, *_ = [importlib.import_module(each) for each in (module, *needs)]
    except ImportError as error:
        missing = (error.name or module).partition(".")[0]
        raise TargetError(f"{missing} is not installed: pip install 'visadapt[rotorpy]'") from error
    return found
