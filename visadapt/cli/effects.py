"""visadapt effects: the catalogue."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from visadapt.cli.arguments import SYSTEMS_HELP, system_class
from visadapt.cli.user_files import import_effects


def add(commands: Any) -> None:
    """Add the subcommand's parser."""
    parser = commands.add_parser(
        "effects",
        help="the effects that a diagnosis can name: equations, parameters, units, ranges",
        description="Lists the effects that separate a real machine from the simulator: the stage of a step at which "
        "each acts, its equation and source, and its parameters with unit and searched range.",
    )
    parser.add_argument(
        "--system", type=system_class, metavar="NAME", help=f"only those that act on it: {SYSTEMS_HELP}"
    )
    parser.add_argument("--effects", metavar="FILE.py", help="a file that defines effects of your own, listed too")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    """Print the catalogue."""
    from visadapt.effects.catalogue import catalogue_text

    if options.effects:
        import_effects(Path(options.effects))
    print(catalogue_text(options.system() if options.system else None))
