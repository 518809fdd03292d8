"""Gentle references with closed forms, and small flights, for the tests of vehicles."""

import dataclasses
import math

import torch

from visadapt.effects import ConstantForce, LinearDrag
from visadapt.setups.flight import quadrotor
from visadapt.systems import Quadrotor
from visadapt.tasks.differential_flatness import commands, demanded
from visadapt.tasks.references import Reference
from visadapt.world import World

PERIOD = 0.1


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


def waves(count, rows=41, seed=0, dtype=torch.float32):
    """References on which each axis swings to and fro by 0.5 m to 1 m, once in 5 s to 10 s."""
    generator = seeded(seed)
    size, speed, phase = torch.rand(3, count, 1, 3, generator=generator, dtype=torch.float64)
    size, speed, phase = 0.5 + size / 2, math.pi / 5 * (1 + speed), 2 * math.pi * phase
    angle = speed * PERIOD * torch.arange(rows)[:, None] + phase
    motion = [size * speed**order * (angle + order * math.pi / 2).sin() for order in range(4)]
    return Reference.of(torch.stack(motion).to(dtype), PERIOD)


def straight(count=2, rows=41, dtype=torch.float32):
    """References that go straight on at a steady velocity, another one each."""
    velocity = torch.randn(count, 1, 3, generator=seeded(5), dtype=torch.float64).expand(count, rows, 3)
    position = velocity * PERIOD * torch.arange(rows)[:, None] + 1.0
    still = torch.zeros_like(velocity)
    return Reference.of(torch.stack((position, velocity, still, still)).to(dtype), PERIOD)


def states_on(reference):
    """The quadrotor's states (..., T, 13) on a reference."""
    demand = demanded(reference.accelerations, reference.jerks)
    return demand.state(reference.positions, reference.velocities)


def small_quadrotor(rows=21, with_history=False, **training):
    """The quadrotor on a few short references; `training` are TuneSettings', in the source and in each round."""
    return trained_as(quadrotor(waves(8, rows), waves(5, rows, seed=1), with_history=with_history), **training)


def trained_as(setup, **training):
    """A setup with other TuneSettings, in the source and in each round."""
    own = setup.settings
    parts = {"source": own.source, "tuning": own.tuning, "refinement": own.refinement}
    changed = {name: dataclasses.replace(part, **training) for name, part in parts.items() if part is not None}
    return dataclasses.replace(setup, settings=dataclasses.replace(own, **changed))


def drag(rate):
    """Draws v' = ... - rate v for the quadrotor of 1 kg."""
    return lambda batch, generator: (LinearDrag(coefficient=rate),)


def push(newtons):
    """Draws a force along x."""
    return lambda batch, generator: (ConstantForce(force=newtons),)


def asked_by(reference):
    """Commands (..., T, 4) that a reference asks for; its snap by differences."""
    jerks = reference.jerks.double()
    snaps = torch.gradient(jerks, spacing=reference.period, dim=-2)[0]
    return commands(reference.accelerations.double(), jerks, snaps, Quadrotor())


def fly_blind(reference):
    """How far in m (T, B) the simulator is off the references when fed what they ask for, and nothing else."""
    asked = asked_by(reference)
    assert asked.abs().max() <= 1
    world = World(Quadrotor(), period=reference.period)
    at = world.start(states_on(reference)[:, 0].double())
    away = []
    for row in range(1, asked.shape[1]):
        at = world.step(at, (asked[:, row - 1] + asked[:, row]) / 2)
        away.append((at.state[:, :3] - reference.positions[:, row]).norm(dim=1))
    return torch.stack(away)
