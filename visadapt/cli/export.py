"""visadapt export: a policy as ONNX, and what its inputs and output are."""

from __future__ import annotations

import argparse

from visadapt.cli.own_classes import import_effects
from visadapt.cli.target import load_policy_and_source
from visadapt.setups.onnx_file import about, export_policy


def run(options: argparse.Namespace) -> None:
    """Write the file, print its metadata."""
    import_effects(options)
    policy, source = load_policy_and_source(options)
    export_policy(options.out, policy, source)
    for name, value in about(policy, source).items():
        print(f"{name:13} {value}")
