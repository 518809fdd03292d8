"""visadapt score: how well a policy does on a target, and a film of it."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path
from typing import Any

from visadapt.cli.arguments import checked, positive
from visadapt.cli.given_effects import import_given
from visadapt.cli.policy_and_target import add_policy_and_target, load_both

SEED = 2026
"""`evaluation.SCORE_SEED`, which a test holds it to: importing that here would make `visadapt --help` slow."""


def add(commands: Any) -> None:
    """Add the subcommand's parser."""
    parser = commands.add_parser(
        "score",
        help="run a policy on a target: its score, failed episodes counted apart, and a film",
        description="Runs episodes of a policy on a target. Cart-poles are scored by the cart's mean speed in m/s over "
        "the episodes that stay up, flights by their distance in m from their line; failed episodes are counted apart.",
    )
    add_policy_and_target(parser)
    parser.add_argument("--episodes", metavar="N", type=positive, default=100, help="(default: 100)")
    parser.add_argument(
        "--seed", metavar="N", type=int, default=SEED, help=f"of the starts and hidden effects (default: {SEED})"
    )
    parser.add_argument("--film", metavar="F.mp4", help="film one more episode")
    parser.add_argument("--json", metavar="F", help="write the score here")
    parser.add_argument("--effects", metavar="FILE.py", help="a file that defines effects the policy was trained with")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    """Score, print, write what was asked for."""
    from visadapt.evaluation import score
    from visadapt.films.filming import film
    from visadapt.storage.run_folder import versions, write_json

    import_given(options)
    policy, _, target = load_both(options)
    found = score(policy, target, options.episodes, options.seed)
    print(found)
    if options.json:
        about = {"policy": options.policy, "target": target.name, "seed": options.seed, "versions": versions()}
        write_json(Path(options.json), {**asdict(found), **about})
    if options.film:
        with checked():
            film(policy, target, options.film)
