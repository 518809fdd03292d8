"""visadapt check: whether a class of the user's own is a system that visadapt can work with."""

from __future__ import annotations

import argparse
import sys

from visadapt.cli.errors import InputError
from visadapt.effects.catalogue import catalogue
from visadapt.systems.contract import complaints, unused_commands, unused_parameters


def run(options: argparse.Namespace) -> None:
    """Print what the class states; or what is wrong with it, a line each."""
    system = options.system
    if wrong := complaints(system):
        *others, last = (f"{system.__name__}: {line}" for line in wrong)
        for line in others:
            print(f"visadapt: {line}", file=sys.stderr)
        raise InputError(last)
    for kind in ("states", "actions", "loads"):
        shown = (f"{one.name} {one.unit} ({one.low:g} to {one.high:g})" for one in getattr(system, kind))
        print(f"{kind:8} {', '.join(shown)}")
    print(f"{'time':8} predictions reach {system.prediction_time:g} s ahead (prediction_time)")
    for kind, names in (("command", unused_commands(system())), ("parameter", unused_parameters(system()))):
        for name in names:
            print(f"{name:8} changes no rate within the ranges: derivative does not use this {kind}")
    print(f"{system.name} is right; {len(catalogue(system()))} effects act on it (visadapt effects --system ...)")
