"""visadapt adapt: the paper's Algorithm 1 on a target, in a folder that an interrupted run goes on from."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from visadapt.cli.arguments import InputError, add_seed, checked, fingerprint, positive, progress
from visadapt.cli.given_effects import add_effects, given_effects, import_given
from visadapt.cli.policy_and_target import add_policy_and_target, load_both

if TYPE_CHECKING:
    from visadapt.policies import Policy


def add(commands: Any) -> None:
    """Add the subcommand's parser."""
    parser = commands.add_parser(
        "adapt",
        help="adapt a policy to a target from few counted samples of it",
        description="Adapts a policy to a target by the paper's Algorithm 1. In each round the policy is run on the "
        "target, a residual learns what the simulator leaves out, and the policy is tuned in the result. Every step of "
        "the target is counted. The folder --out keeps settings, seed, versions, recordings, ledger and policy; "
        "interrupted, the same command goes on where it was.",
    )
    add_policy_and_target(parser)
    parser.add_argument("--out", required=True, metavar="FOLDER", help="folder of the run; policy.safetensors in it")
    parser.add_argument(
        "--samples", metavar="N", type=positive, default=1000, help="steps of the target in all (default: 1000)"
    )
    parser.add_argument(
        "--round", metavar="B", type=positive, help="steps of the target in a round (default: a fifth of --samples)"
    )
    parser.add_argument(
        "--renderer",
        metavar="R.safetensors",
        help="the one that the policy was trained with (default: of a cart-pole that is drawn)",
    )
    parser.add_argument("--references", metavar="F.csv", help="what a quadrotor is to follow, if the target has none")
    parser.add_argument(
        "--with-history", action="store_true", help="let a vehicle's residual read the last periods too"
    )
    add_effects(parser)
    parser.add_argument("--iterations", metavar="N", type=positive, help="of tuning in a round (default: the system's)")
    add_seed(parser)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    """Adapt the policy in the folder of the run."""
    from visadapt.setups.training import adapt, setup_for
    from visadapt.storage.run_folder import open_run, write_json
    from visadapt.tasks.references import read_reference
    from visadapt.world import World

    import_given(options)
    policy, source, target = load_both(options)
    if effects := given_effects(options, source.system):
        source = World(source.system, effects, source.period, source.integrator, source.substeps)
    _check_renderer(options, policy)
    references = read_reference(options.references, source.period) if options.references else None
    with checked():
        setup_for(
            source, policy, options.renderer, references or getattr(getattr(target, "task", None), "references", None)
        )
    in_round = options.round or min(options.samples, max(20, options.samples // 5))
    if in_round > options.samples:
        raise InputError(f"--round {in_round} is more than --samples {options.samples}: lower it, or raise those")
    folder = Path(options.out)
    settings = {name: value for name, value in vars(options).items() if name not in ("run", "out")}
    for name in ("policy", "renderer", "references", "diagnosis", "map"):
        settings[f"{name} SHA-256"] = fingerprint(settings[name])
    open_run(folder, settings)
    with progress() as report:
        adapted = adapt(
            policy,
            source,
            target,
            samples=options.samples,
            folder=folder,
            seed=options.seed,
            round_samples=in_round,
            iterations=options.iterations,
            renderer=options.renderer,
            references=references,
            with_history=options.with_history,
            report=report,
        )
    rounds = [{"samples": each.samples, "policy_loss": each.policy[-1]} for each in adapted.rounds]
    write_json(folder / "ledger.json", {**asdict(adapted.ledger), "used": adapted.ledger.used, "rounds": rounds})
    print(f"{adapted.ledger.used} samples of {target.name} used; the policy is {folder / 'policy.safetensors'}")


def _check_renderer(options: argparse.Namespace, policy: Policy) -> None:
    """Raises InputError where the policy was not trained through the renderer that it is to be adapted through."""
    import torch

    from renderers import load_renderer
    from visadapt.policies import ImagePolicy
    from visadapt.weights import shipped

    if not isinstance(policy, ImagePolicy):
        if options.renderer:
            raise InputError(f"{options.policy}: is shown states, for which --renderer has no use: leave it out")
        return
    path = Path(options.renderer or shipped("renderer"))
    background, trained = load_renderer(path).state_dict().get("background"), policy.perception.background
    if background is None or background.shape != trained.shape or not torch.allclose(background.sigmoid(), trained):
        raise InputError(
            f"{options.policy}: was not trained with the renderer {path}: give by --renderer the one that it was "
            "trained with"
        )
