"""The arguments of each subcommand. Nothing here loads slowly, so that `visadapt --help` answers at once."""

from __future__ import annotations

import argparse
import math
import re
from contextlib import suppress
from typing import TYPE_CHECKING, Any

from visadapt.cli.errors import InputError

if TYPE_CHECKING:
    from visadapt.systems import System

SYSTEMS_HELP = "cartpole, quadrotor or fixed_wing"
OWN_HELP = "or my_rig.py:Class, a system of your own (docs/own_system.md)"
POLICY_HELP = "as `visadapt train` or `visadapt adapt` wrote it"
LONGEST_NUMBER = 18  # Digits of a whole number
SCORE_SEED = 2026
"""Equal to `evaluation.SCORE_SEED`, as a test checks."""


def diagnose(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `visadapt diagnose`."""
    parser.description = (
        "Says where a recording departs from the simulator, which named effects cause it, and how much of the gap they "
        "close. The verdict goes to the terminal; exit status 0: a diagnosis was made, 2: bad input."
    )
    add = parser.add_argument
    add("recording", nargs="+", metavar="RECORDING", help="CSV or HDF5 files, logs of ROS or PX4, or folders of these")
    _add_system(parser)
    columns_help = (
        "our name=the name in the file, as in x=position,theta=phi, perhaps converted: theta=encoder*2*pi/4096-pi, "
        "time=stamp/1000; theta= is a state that was not measured; may be repeated"
    )
    add("--columns", metavar="A=B,...", type=_columns, default={}, action=_Merged, help=columns_help)
    add("--effects", metavar="FILE.py", help="a file that defines effects of your own")
    renderer_help = "for a film without states: draws its scene from cart position and pole angle (`visadapt renderer`)"
    add("--renderer", metavar="R.safetensors", help=renderer_help)
    add(
        "--policy",
        metavar="P.safetensors",
        help="a policy on states, as `visadapt train` writes it: --plan adds to its commands, and for a cart-pole's "
        "the terms of the paper's Theorem 1 are given, on the terminal and in the report",
    )
    add("--json", metavar="F", help="write the result here as JSON (schema: visadapt/diagnosis/schema.json)")
    add("--report", metavar="F.html", help="write a page with figures here")
    plan_help = "where several effects fit equally well, write here what to add to the commands to tell them apart"
    add("--plan", metavar="F.csv", help=plan_help)
    _add_seed(parser)
    add("--jobs", metavar="N", type=_positive, default=1, help="processes that share the work (default: 1)")


def effects(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `visadapt effects`."""
    parser.description = (
        "Lists the effects that separate a real machine from the simulator: the stage of a step at which each acts, "
        "its equation and source, and its parameters with unit and searched range."
    )
    add = parser.add_argument
    add("--system", type=_system, metavar="NAME", help=f"only those that act on it: {SYSTEMS_HELP}, {OWN_HELP}")
    add("--effects", metavar="FILE.py", help="a file that defines effects of your own, listed too")


def check(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `visadapt check`."""
    parser.description = (
        "Tests a system of your own, a class that derives from visadapt.System: names, units and ranges, and a "
        "derivative that is finite, differentiable and batched and fits them. Prints each fault on a line; exit status "
        "0: no fault, 2: faults."
    )
    parser.add_argument("system", type=_system, metavar="my_rig.py:Class", help="the file and the class")


def renderer(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `visadapt renderer`."""
    parser.description = (
        "Trains a renderer, states to frames, from recordings of a cart-pole that hold both, or from what a gymnasium "
        "environment shows of chosen states. --hinge and --scale are a first guess of the camera, accurate to some "
        "pixels; training refines it. Interrupted, the same command goes on where it was."
    )
    add = parser.add_argument
    add("recording", nargs="*", metavar="RECORDING.h5", help="HDF5 with frames, as visadapt.write_recording writes it")
    _add_target(parser, required=False)
    add("--show", metavar="N", type=_positive, help="states that --target is put into (default: 4000)")
    within_help = "largest |x| in m and |theta| in rad of these states (default: 1.0,0.35)"
    add("--within", metavar="X,THETA", type=_pair, help=within_help)
    add("--out", required=True, metavar="R.safetensors", help="write the renderer here")
    add("--hinge", required=True, type=_pair, metavar="COLUMN,ROW", help="px, where the pole's hinge is seen at x = 0")
    add("--scale", required=True, type=_positive_number, metavar="PX", help="px per m")
    pole_help = "m from the hinge to the pole's tip; better too long than too short (default: 1.05)"
    add("--pole", type=_positive_number, default=1.05, metavar="M", help=pole_help)
    add("--iterations", metavar="N", type=_positive, default=1000, help="(default: 1000)")
    _add_seed(parser)


def train(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `visadapt train`."""
    parser.description = (
        "Trains a policy by backpropagation through the simulator: on states or, for a cart-pole, on a camera's "
        "frames. With --diagnosis or --effect the simulator has these effects. Interrupted, the same command goes on "
        "where it was."
    )
    add = parser.add_argument
    _add_system(parser)
    task_help = "where a system of your own is to come to rest, and how exactly (docs/own_system.md)"
    add("--task", metavar="TASK.toml", help=task_help)
    add("--out", required=True, metavar="P.safetensors", help="write the policy here")
    add(
        "--period",
        metavar="S",
        type=_positive_number,
        help="s between commands (default: 0.05; quadrotor: 0.1; with --task: needed)",
    )
    add("--frames", action="store_true", help="the policy is shown a camera's frames, not states")
    add(
        "--renderer",
        metavar="R.safetensors",
        help="the camera, as `visadapt renderer` writes it; implies --frames (default: that of the drawn cart-pole)",
    )
    add("--references", metavar="F.csv", help="what a quadrotor is to follow: columns time, x, y, z in s and m")
    add("--with-history", action="store_true", help="let a cart-pole's policy on states read the last 5 periods")
    _add_effects(parser)
    add("--iterations", metavar="N", type=_positive, help="iterations of training (default: the system's own)")
    add("--seeing", metavar="N", type=_positive, help="iterations of the frame encoder's training")
    _add_seed(parser)


def adapt(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `visadapt adapt`."""
    parser.description = (
        "Adapts a policy to a target by the paper's Algorithm 1. In each round the policy is run on the target, a "
        "residual learns what the simulator leaves out, and the policy is tuned in the result. Every step of the "
        "target is counted. The folder --out keeps settings, seed, versions, recordings, ledger and policy; "
        "interrupted, the same command goes on where it was."
    )
    add = parser.add_argument
    _add_policy_and_target(parser)
    add("--out", required=True, metavar="FOLDER", help="folder of the run; it gets the policy, policy.safetensors")
    add("--samples", metavar="N", type=_positive, default=1000, help="steps of the target in all (default: 1000)")
    round_help = "steps of the target in a round (default: a fifth of --samples, at least 20)"
    add("--round", metavar="B", type=_positive, help=round_help)
    renderer_help = "the one that the policy was trained with (default: that of the drawn cart-pole)"
    add("--renderer", metavar="R.safetensors", help=renderer_help)
    add("--references", metavar="F.csv", help="what a quadrotor is to follow, if the target has none")
    add("--with-history", action="store_true", help="let a vehicle's residual read the last periods too")
    diagnose_help = "name the causes of the gap in each round; a residual learns it only where they do not explain it"
    add("--diagnose", action="store_true", help=diagnose_help)
    _add_effects(parser)
    add("--iterations", metavar="N", type=_positive, help="iterations of tuning in a round (default: the system's)")
    _add_seed(parser)


def score(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `visadapt score`."""
    parser.description = (
        "Runs episodes of a policy on a target. Cart-poles are scored by the cart's mean speed in m/s over the "
        "episodes that stay up, flights by their mean error in m, systems with a task by their distances from its "
        "goal; failed episodes are counted apart."
    )
    add = parser.add_argument
    _add_policy_and_target(parser)
    add("--references", metavar="F.csv", help="what a quadrotor is to follow, if the target has none")
    add("--episodes", metavar="N", type=_positive, default=100, help="(default: 100)")
    seed_help = f"seed of the starts and hidden effects (default: {SCORE_SEED})"
    add("--seed", metavar="N", type=_seed, default=SCORE_SEED, help=seed_help)
    add("--film", metavar="F.mp4", help="write a film of one more episode here")
    add("--json", metavar="F", help="write the score here")
    add("--effects", metavar="FILE.py", help="a file that defines effects the policy was trained with")


def export(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `visadapt export`."""
    parser.description = (
        "Writes a policy, with the residual that it reads, as an ONNX file: the last five observations and actions to "
        "the next ten actions, of which the first is executed. Its actions are checked against the policy's."
    )
    parser.add_argument("policy", metavar="P.safetensors", help=POLICY_HELP)
    _add_policys_system(parser)
    parser.add_argument("--out", metavar="P.onnx", required=True, help="the file to write")
    effects_help = "a file that defines effects the policy was trained with"
    parser.add_argument("--effects", metavar="FILE.py", help=effects_help)


def _add_system(parser: argparse.ArgumentParser) -> None:
    system_help = f"the source physics: {SYSTEMS_HELP}, {OWN_HELP}"
    parser.add_argument("--system", required=True, type=_system, metavar="NAME", help=system_help)
    parser.add_argument("--params", metavar="RIG.toml", help="the rig's own parameters, in a table [parameters]")


def _add_seed(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seed", metavar="N", type=_seed, default=0, help="seed of everything random (default: 0)")


def _add_effects(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--diagnosis",
        metavar="D.json",
        help="put the effects that `visadapt diagnose --json` named into the simulator, in place of those it has",
    )
    parser.add_argument(
        "--effect",
        metavar="NAME:PARAMETER=VALUE,...",
        action="append",
        default=[],
        help="put an effect into the simulator, as in viscous_friction:coefficient=2.1 (`visadapt effects` lists them "
        "with their units), in place of those it has and of the one of its name in --diagnosis; may be repeated",
    )
    parser.add_argument("--effects", metavar="FILE.py", help="a file that defines effects of your own")


def _add_policy_and_target(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--policy", required=True, metavar="P.safetensors", help=POLICY_HELP)
    _add_policys_system(parser)
    _add_target(parser, required=True)


def _add_policys_system(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--system",
        type=_system,
        metavar="my_rig.py:Class",
        help="the system that the policy was trained for, if it is one of your own: the policy's file has its name, "
        "not its class",
    )


def _add_target(parser: argparse.ArgumentParser, required: bool) -> None:
    parser.add_argument(
        "--target",
        required=required,
        metavar="TARGET",
        help="the machine: a gymnasium id with --map, or package.module:factory, a function without arguments that "
        "returns a visadapt.Target, or, with --map, a gymnasium environment; modules in the current folder are found "
        "too",
    )
    parser.add_argument("--map", metavar="MAP.toml", help="what the numbers and frames of a gymnasium environment mean")


def _positive(text: str) -> int:
    """A whole number from 1 on."""
    if not text.isdecimal() or len(text) > LONGEST_NUMBER or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text[:40]!r} is not a whole number from 1 on")
    return int(text)


def _seed(text: str) -> int:
    """A whole number that a random generator accepts as seed."""
    with suppress(ValueError):
        if len(text) <= LONGEST_NUMBER:
            return int(text)
    raise argparse.ArgumentTypeError(f"{text[:40]!r} is not a whole number of at most {LONGEST_NUMBER} digits")


def _positive_number(text: str) -> float:
    """A finite number above 0."""
    if not (number := _finite(text)) > 0:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number above 0")
    return number


def _pair(text: str) -> tuple[float, float]:
    """Two finite numbers with a comma between them."""
    if text.count(",") != 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not two numbers with a comma between them")
    first, second = map(_finite, text.split(","))
    return first, second


def _finite(text: str) -> float:
    with suppress(ValueError):
        if math.isfinite(number := float(text)):
            return number
    raise argparse.ArgumentTypeError(f"{text!r} is not a finite number")


def _system(text: str) -> type[System]:
    """The system of a name, or of a file of the user's."""
    from visadapt.systems import SYSTEMS

    if text in SYSTEMS:
        return SYSTEMS[text]
    if ".py" not in text:
        raise argparse.ArgumentTypeError(
            f"there is no system {text!r}; there are {', '.join(SYSTEMS)}, and your own as my_rig.py:Class"
        )
    from visadapt.cli.own_classes import find_system

    try:
        return find_system(text)
    except InputError as error:
        raise argparse.ArgumentTypeError(str(error)) from error


class _Merged(argparse.Action):
    """Columns of an option that may be repeated."""

    def __call__(
        self, parser: argparse.ArgumentParser, namespace: argparse.Namespace, values: Any, option: str | None = None
    ) -> None:
        columns = getattr(namespace, self.dest)
        if twice := columns.keys() & values:
            raise argparse.ArgumentError(self, f"{min(twice)} is given twice")
        setattr(namespace, self.dest, {**columns, **values})


def _columns(text: str) -> dict[str, str]:
    """The file's names of columns by ours."""
    columns: dict[str, str] = {}
    for pair in re.split(r",(?=[^,=]+=)", text):  # a name in the file may have commas
        ours, equals, theirs = (part.strip() for part in pair.partition("="))
        if not ours or not equals:
            raise argparse.ArgumentTypeError(f"{pair!r} is not of the form x=position")
        if ours in columns:
            raise argparse.ArgumentTypeError(f"{ours} is given twice")
        columns[ours] = theirs
    return columns
