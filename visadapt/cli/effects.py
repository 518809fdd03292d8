"""visadapt effects: the catalogue."""

from __future__ import annotations

import argparse

from visadapt.cli.own_classes import import_effects
from visadapt.cli.simulator import given_system
from visadapt.effects.catalogue import catalogue_text


def run(options: argparse.Namespace) -> None:
    """Print the catalogue."""
    import_effects(options)
    print(catalogue_text(given_system(options) if options.system else None))
