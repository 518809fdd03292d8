"""visadapt effects: the catalogue."""

from __future__ import annotations

import argparse

from visadapt.cli.inputs import import_effects
from visadapt.effects.catalogue import catalogue_text


def run(options: argparse.Namespace) -> None:
    """Print the catalogue."""
    import_effects(options)
    print(catalogue_text(options.system() if options.system else None))
