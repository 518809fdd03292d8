"""visadapt train: a policy for the simulator, or for the simulator with what a diagnosis found."""

from __future__ import annotations

import argparse
import math
from dataclasses import replace
from pathlib import Path

from visadapt.cli.errors import InputError
from visadapt.cli.own_classes import import_effects
from visadapt.cli.progress import progress
from visadapt.cli.run_folders import run_settings, unfinished
from visadapt.cli.simulator import given_effects, given_system
from visadapt.cli.user_code import as_input_error
from visadapt.learning.perception import PerceptionSettings
from visadapt.setups.base import Setup
from visadapt.setups.training import setup_to_train
from visadapt.storage.atomic_files import replacing
from visadapt.systems import CartPole, Quadrotor
from visadapt.tasks.references import read_reference
from visadapt.tasks.regulate import read_task
from visadapt.weights import shipped
from visadapt.world import World

LONGEST_STEP = 0.05
"""Longest integration step of the simulator, s."""


def run(options: argparse.Namespace) -> None:
    """Train the policy and write it."""
    import_effects(options)
    out = Path(options.out)
    setup = _setup(options)
    settings = run_settings(options, "renderer", "references", "task", "diagnosis", "params", "effects")
    with unfinished(out, {**settings, "system": options.system.name}) as folder, progress() as report:
        made = folder / "policy.safetensors"
        setup.pretrain(made, options.seed, report)
        with replacing(out) as temporary:
            temporary.write_bytes(made.read_bytes())
    print(out)


def _setup(options: argparse.Namespace) -> Setup:
    system = given_system(options)
    task = read_task(options.task, system) if options.task else None
    if task and not options.period:
        raise InputError("--task: say how often the rig is commanded: --period, in s, is needed")
    period = options.period or (0.1 if isinstance(system, Quadrotor) else 0.05)
    bare = World(system, (), period, substeps=None if task else math.ceil(period / LONGEST_STEP))
    world = bare.with_effects(given_effects(options, system))
    renderer = options.renderer or (shipped("renderer") if options.frames else None)
    if renderer and not isinstance(system, CartPole):
        raise InputError(f"a {system.name} has no renderer: --frames and --renderer are for a cartpole")
    if options.seeing and not renderer:
        raise InputError("--seeing is for a policy that is shown frames: give --frames or --renderer")
    if options.references and not isinstance(system, Quadrotor):
        raise InputError(f"--references is for a quadrotor, not for a {system.name}")
    references = read_reference(options.references, period) if options.references else None
    with as_input_error():
        setup = setup_to_train(world, options.iterations, renderer, references, options.with_history, task)
    if not options.seeing:
        return setup
    perception = replace(setup.settings.perception or PerceptionSettings(), iterations=options.seeing)
    return replace(setup, settings=replace(setup.settings, perception=perception))
