"""visadapt score: how well a policy does on a target, and a film of it."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path

from visadapt.cli.own_classes import import_effects
from visadapt.cli.target import load_policy_and_target
from visadapt.cli.user_code import as_input_error
from visadapt.evaluation import score
from visadapt.films.filming import check_filmable, film
from visadapt.storage.run_folder import versions, write_json


def run(options: argparse.Namespace) -> None:
    """Score, print, write what was asked for."""
    import_effects(options)
    policy, _, target = load_policy_and_target(options)
    with as_input_error():
        if options.film:
            check_filmable(target)
        found = score(policy, target, options.episodes, options.seed)
    if options.json:
        about = {"policy": options.policy, "target": target.name, "seed": options.seed, "versions": versions()}
        write_json(Path(options.json), {**asdict(found), **about})
    try:
        if options.film:
            with as_input_error():
                film(policy, target, options.film, seed=options.seed)
    finally:
        print(found)  # last, since whoever reads it may stop reading
