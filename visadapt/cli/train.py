"""visadapt train: a policy for the simulator, or for the simulator with what a diagnosis found."""

from __future__ import annotations

import argparse
import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from visadapt.cli.arguments import (
    InputError,
    add_seed,
    add_system,
    checked,
    fingerprint,
    positive,
    positive_number,
    progress,
    the_system,
    unfinished,
)
from visadapt.cli.given_effects import add_effects, given_effects, import_given

if TYPE_CHECKING:
    from visadapt.learning.joint import SetupSettings
    from visadapt.learning.policy import TuneSettings
    from visadapt.setups.base import Setup

LONGEST_STEP = 0.05
"""s that the simulator integrates at once."""


def add(commands: Any) -> None:
    """Add the subcommand's parser."""
    parser = commands.add_parser(
        "train",
        help="train a policy in the simulator, with the effects of a diagnosis if there are any",
        description="Trains a policy by backpropagation through the simulator: on states, or, of a cart-pole, on a "
        "camera's frames. With --diagnosis or --effect the simulator has these effects. Interrupted, the same command "
        "goes on where it was.",
    )
    add_system(parser)
    parser.add_argument("--out", required=True, metavar="P.safetensors", help="write the policy here")
    parser.add_argument(
        "--period", metavar="S", type=positive_number, help="s between commands (default: 0.05; quadrotor: 0.1)"
    )
    parser.add_argument("--frames", action="store_true", help="the policy is shown a camera's frames, not states")
    parser.add_argument(
        "--renderer",
        metavar="R.safetensors",
        help="the camera, as `visadapt renderer` writes it; implies --frames (default: of a cart-pole that is drawn)",
    )
    parser.add_argument(
        "--references", metavar="F.csv", help="what a quadrotor is to follow: columns time, x, y, z in s and m"
    )
    parser.add_argument(
        "--with-history", action="store_true", help="read the last 5 periods too, as against a force that changes"
    )
    add_effects(parser)
    parser.add_argument("--iterations", metavar="N", type=positive, help="of the policy (default: the system's own)")
    parser.add_argument(
        "--seeing", metavar="N", type=positive, help="iterations in which an encoder of frames learns to see"
    )
    add_seed(parser)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    """Train the policy and write it."""
    from visadapt.storage.atomic_files import replacing

    import_given(options)
    out = Path(options.out)
    setup = _setup(options)
    settings = {name: value for name, value in vars(options).items() if name not in ("run", "out", "system")}
    for name in ("renderer", "references", "diagnosis", "params"):
        settings[name] = fingerprint(settings[name])
    with unfinished(out, {"system": options.system.name, **settings}) as folder, progress() as report:
        made = folder / "policy.safetensors"
        setup.pretrain(made, options.seed, report)
        with replacing(out) as temporary:
            temporary.write_bytes(made.read_bytes())
    print(out)


def _setup(options: argparse.Namespace) -> Setup:
    from visadapt.learning.perception import PerceptionSettings
    from visadapt.setups.cartpole import cartpole_frames
    from visadapt.setups.training import setup_for
    from visadapt.systems import CartPole, Quadrotor
    from visadapt.tasks.references import read_reference
    from visadapt.world import World

    system = the_system(options)
    period = options.period or (0.1 if isinstance(system, Quadrotor) else 0.05)
    world = World(system, given_effects(options, system), period, substeps=math.ceil(period / LONGEST_STEP))
    seen = bool(options.frames or options.renderer)
    if seen and not isinstance(system, CartPole):
        raise InputError(f"a {system.name} has no renderer: --frames and --renderer are for a cartpole")
    if options.seeing and not seen:
        raise InputError("--seeing is for a policy that is shown frames: give --frames or --renderer")
    if options.references and not isinstance(system, Quadrotor):
        raise InputError(f"--references is for a quadrotor, not for a {system.name}")
    references = read_reference(options.references, period) if options.references else None
    with checked():
        if not seen:
            setup = setup_for(world, references=references, with_history=options.with_history)
            return replace(setup, settings=replace(setup.settings, source=_source(setup.settings, options)))
    own = cartpole_frames(world, options.renderer).settings
    own = replace(own, source=_source(own, options))
    if options.seeing:
        perception = own.perception or PerceptionSettings()
        own = replace(own, perception=replace(perception, iterations=options.seeing))
    return cartpole_frames(world, options.renderer, own)


def _source(settings: SetupSettings, options: argparse.Namespace) -> TuneSettings:
    """How the policy is trained, with the number of iterations that --iterations asks for."""
    return replace(settings.source, iterations=options.iterations or settings.source.iterations)
