"""Runs every command that the tables of README.md and docs/ come from, all at one commit of the code.

    python -m benchmarks.all --list
    python -m benchmarks.all [--only flight power_loop]

A command that has succeeded at this commit is skipped, so an interrupted run is started again the same way. The commit
is the last one that changed code or shipped weights: committing tables and pages starts nothing again. Intermediate
results go to runs/all/<commit>/<name>, so none of another commit is taken over; recordings of the sealed check and
references, under data/, are made once and kept. Each command writes runs/all/<name>.log and, after success alone, its
date and commit into results/runs.json, which is committed with the tables, so that a run goes on on another machine.
`python -m benchmarks.pages` then writes the tables into the pages.
"""

from __future__ import annotations

import json
import shlex
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from importlib.util import find_spec
from pathlib import Path

import tyro

from visadapt.storage.atomic_files import replacing

CODE = (
    "visadapt",
    "renderers",
    "datasets",
    "experiments",
    "train",
    "benchmarks/*.py",
    "benchmarks/baselines",
    "benchmarks/blind",
    "assets/*.safetensors",
    "constraints.txt",
    "pyproject.toml",
)
"""What tables depend on, as git's path patterns."""
RUNS = Path("results/runs.json")
"""The `Stamp` of each command that has succeeded, by its name."""
NOT_CODE = (":!benchmarks/all.py", ":!benchmarks/pages.py", ":!benchmarks/tables_*.py")
"""Scripts that no number depends on, excluded from CODE."""


@dataclass(frozen=True)
class Command:
    """One command and the table that it writes, or adds its rows to."""

    name: str
    """names its log, its stamp and its folder of intermediate results"""
    table: str
    """file in results/"""
    arguments: tuple[str, ...]
    """the module and its options, as the pages show them"""
    minutes: int
    """estimate for two cores"""
    work: str = ""
    """option that names the folder of intermediate results, where the command keeps any"""
    reads: tuple[tuple[str, str], ...] = ()
    """(option, name of the earlier command whose intermediate results it reads)"""
    extra: str = ""
    """optional dependency of the package that it needs"""

    @property
    def shown(self) -> str:
        """As a user types it."""
        return "python -m " + shlex.join(self.arguments)


def _blind(name: str, options: str, minutes: int, table: str = "blind_diagnosis.csv") -> Command:
    arguments = ("benchmarks.blind.diagnosis", *options.split())
    return Command(name, table, arguments, minutes, work="--work")


COMMANDS = (
    Command("renderers", "renderers.csv", ("benchmarks.renderers",), 1),
    Command("action_times", "action_times.csv", ("benchmarks.action_times",), 1, extra="onnx"),
    Command("power_loop", "power_loop.csv", ("benchmarks.power_loop",), 10),
    Command("residual_samples", "residual_samples.csv", ("benchmarks.residual_samples",), 5),
    Command("cartpole_states", "cartpole_states.csv", ("benchmarks.cartpole_states",), 20, work="--work"),
    Command("swing_up", "swing_up.csv", ("train.swing_up",), 60, work="--work"),
    Command("swing_up_ppo", "swing_up_ppo.csv", ("benchmarks.swing_up_ppo",), 10, extra="baselines"),
    Command("cartpole_pixels", "cartpole_pixels.csv", ("benchmarks.cartpole_pixels",), 30, work="--work"),
    Command(
        "ablations",
        "ablations.csv",
        (
            "benchmarks.ablations",
            *("--seeds", "2"),
            *("--targets", "2(sin t + 1) N", "dry friction 4 N", "delay 0.05 s and 1 N"),
            *("--variants", "as shipped", "no tuning", "no feed-forward", "output layer alone"),
            *("gradient past the renderer", "gradient past the residual", "correction held over a plan"),
            *("no unexplained accelerations", "MLP residual", "MLP renderer", "smallest ridge"),
            *("each round tunes on", "each round from the source policy", "true effect, tuned"),
        ),
        40,
        work="--work",
    ),
    Command(
        "ablations_states",
        "ablations_states.csv",
        (
            "benchmarks.ablations",
            *("--shown", "states", "--out", "results/ablations_states.csv", "--seeds", "2"),
            *("--targets", "2(sin t + 1) N", "dry friction 4 N", "delay 0.05 s and 1 N"),
            *("--variants", "as shipped", "no tuning", "no feed-forward", "output layer alone"),
            *("gradient past the residual", "correction held over a plan"),
            *("no history", "no unexplained accelerations", "MLP residual", "each round tunes on"),
            *("true effect, tuned", "true effect, trained anew"),
        ),
        25,
        work="--work",
    ),
    Command("ablations_flight", "ablations_flight.csv", ("benchmarks.ablations_flight",), 20, work="--work"),
    Command("other_targets", "other_targets.csv", ("benchmarks.other_targets",), 40, work="--work"),
    Command(
        "other_targets_states",
        "other_targets_states.csv",
        ("benchmarks.other_targets", "--shown", "states", "--out", "results/other_targets_states.csv"),
        20,
        work="--work",
    ),
    Command(
        "inverted_pendulum",
        "inverted_pendulum.csv",
        ("train.inverted_pendulum", "--seeds", "0", "1", "2"),
        30,
        work="--out",
        extra="mujoco",
    ),
    Command(
        "dm_control",
        "dm_control.csv",
        ("benchmarks.dm_control_balance",),
        60,
        work="--work",
        extra="dm_control",
    ),
    Command("flight", "flight.csv", ("benchmarks.flight",), 60, work="--work"),
    Command(
        "data_collection",
        "data_collection.csv",
        ("benchmarks.data_collection",),
        40,
        work="--work",
        extra="baselines",
        reads=(("--current", "flight"),),
    ),
    Command(
        "theorem",
        "theorem.csv",
        ("benchmarks.theorem",),
        10,
        reads=(("--cartpole", "cartpole_states"), ("--flight", "flight")),
    ),
    Command("named_effects", "named_effects.csv", ("benchmarks.named_effects",), 30, work="--work"),
    Command("named_control", "named_control.csv", ("benchmarks.named_control", "--seeds", "2"), 80, work="--work"),
    Command(
        "named_control_frames",
        "named_control_frames.csv",
        ("benchmarks.named_control", "--shown", "frames", "--seeds", "2", "--out", "results/named_control_frames.csv"),
        40,
        work="--work",
    ),
    Command("own_system", "own_system.csv", ("benchmarks.own_system",), 30, work="--work"),
    Command(
        "planned_experiments",
        "planned_experiments.csv",
        ("benchmarks.planned_experiments",),
        20,
        work="--work",
    ),
    Command("sticking", "sticking.csv", ("benchmarks.sticking",), 5, work="--work"),
    Command("vibrations", "vibrations.csv", ("benchmarks.vibrations", "--seeds", "2"), 10, work="--work"),
    Command(
        "baselines",
        "baselines.csv",
        ("benchmarks.baselines", "--episodes", "20"),
        60,
        work="--work",
        extra="baselines",
    ),
    Command(
        "baselines_flight",
        "baselines_flight.csv",
        (
            "benchmarks.baselines",
            *("--baselines", "mpc", "ppo", "pets"),
            *("--experiments", "quadrotor, drag", "fixed wing, drag", "--episodes", "20"),
            *("--out", "results/baselines_flight.csv", "--picture", "assets/baselines_flight.png"),
        ),
        50,
        work="--work",
        extra="baselines",
    ),
    Command(
        "baselines_frames",
        "baselines_frames.csv",
        (
            "benchmarks.baselines",
            *("--baselines", "mpc", "mpc_pixels", "ppo"),
            *("--experiments", "CartPole, pixels, 2(sin t + 1) N", "--episodes", "20"),
            *("--out", "results/baselines_frames.csv", "--picture", "runs/baselines_frames.png"),
        ),
        100,
        work="--work",
        extra="baselines",
    ),
    Command(
        "rotorpy",
        "rotorpy.csv",
        ("train.rotorpy_quadrotor", "--seeds", "0", "1", "2"),
        60,
        work="--out",
        extra="rotorpy",
    ),
    Command(
        "rotorpy_diagnosis",
        "rotorpy_diagnosis.csv",
        ("benchmarks.rotorpy_diagnosis", "--kinds", "no air", "still air"),
        15,
        work="--out",
        extra="rotorpy",
    ),
    _blind(
        "blind_2029",
        "--seed 2029 --kinds hard --count 100 --jobs 2 --diagnosers ours --out results/blind_diagnosis_2029.csv",
        15,
        "blind_diagnosis_2029.csv",
    ),
    Command(
        "ablations_diagnosis",
        "ablations_diagnosis.csv",
        ("benchmarks.diagnosis_ablations",),
        60,
        work="--work",
    ),
    Command(
        "ablations_diagnosis_large",
        "ablations_diagnosis.csv",
        (
            "benchmarks.diagnosis_ablations",
            *("--kinds", "large", "--count", "20"),
            *("--parts", "every effect alone", "exchanges", "two for one"),
        ),
        40,
        work="--work",
    ),
    *(
        Command(
            f"ablations_diagnosis_{kind}",
            "ablations_diagnosis.csv",
            ("benchmarks.diagnosis_ablations", "--kinds", kind, "--count", "32", "--effects", "all"),
            40,
            work="--work",
        )
        for kind in ("rig", "table")
    ),
    Command(
        "ablations_diagnosis_explained",
        "ablations_diagnosis.csv",
        (
            "benchmarks.diagnosis_ablations",
            *("--kinds", "table", "--count", "32", "--effects", "all"),
            *("--parts", "no further where all is explained"),
        ),
        10,
        work="--work",
    ),
    _blind("blind_hard", "--seed 2028 --kinds hard --count 100 --jobs 2", 20),
    _blind("blind_easy", "--seed 2028 --kinds easy --count 24 --jobs 2", 20),
    _blind(
        "blind_rig",
        "--seed 2045 --kinds rig --effects all --count 48 --jobs 2 --diagnosers ours --out results/blind_rigs.csv",
        20,
        "blind_rigs.csv",
    ),
    _blind(
        "blind_large",
        "--seed 2045 --kinds large --effects all --count 24 --jobs 2 --diagnosers ours --out results/blind_rigs.csv",
        10,
        "blind_rigs.csv",
    ),
    _blind(
        "blind_table",
        "--seed 2045 --kinds table --jobs 2 --diagnosers ours --out results/blind_rigs.csv",
        10,
        "blind_rigs.csv",
    ),
    _blind(
        "blind_frames",
        "--seed 2060 --kinds film_plain film_textured --count 40 --jobs 2 --diagnosers ours "
        "--out results/blind_frames.csv",
        30,
        "blind_frames.csv",
    ),
    _blind(
        "blind_quadrotor",
        "--system quadrotor --count 24 --seed 2032 --jobs 2 --diagnosers ours refit chance",
        10,
    ),
    _blind(
        "blind_fixed_wing",
        "--system fixed_wing --count 24 --seed 2032 --jobs 2 --diagnosers ours refit chance",
        10,
    ),
)
"""In an order in which each finds what it reads."""

INSTALLED_BY = {
    "baselines": "casadi",
    "dm_control": "dm_control",
    "mujoco": "mujoco",
    "onnx": "onnxruntime",
    "rotorpy": "rotorpy",
}
"""Of an extra: the package whose absence says that the extra is not installed."""


@dataclass(frozen=True)
class Settings:
    """What is run, and where its logs and stamps go."""

    only: tuple[str, ...] = ()
    """names of commands; without, all"""
    list: bool = False
    """print the commands and whether they are done at this commit, and run nothing"""
    out: Path = Path("runs/all")


@dataclass(frozen=True)
class Stamp:
    """Says at which commit a command last succeeded."""

    commit: str
    date: str
    """YYYY-MM-DD, UTC"""
    command: str
    minutes: float | None = None
    """wall time; None where it was not recorded"""


def main(settings: Settings) -> int:
    """Run what is not done; 0 where every command asked for is done at this commit, 1 where one failed."""
    names = [command.name for command in COMMANDS]
    if unknown := sorted(set(settings.only) - set(names)):
        raise SystemExit(f"no such command: {', '.join(unknown)}; there are {', '.join(names)}")
    commit = code_commit()
    chosen = [command for command in COMMANDS if not settings.only or command.name in settings.only]
    if settings.list:
        for command in chosen:
            print(described(command, commit))
        return 0
    if changed := _git("status", "--porcelain", "--", *CODE, *NOT_CODE):
        raise SystemExit(f"code is not committed, so tables would not be of commit {commit}:\n{changed}")
    failed = run_all(chosen, settings.out, commit)
    if failed:
        print(f"not done: {', '.join(failed)}; see {settings.out}/<name>.log", file=sys.stderr)
    return 1 if failed else 0


def run_all(commands: Sequence[Command], out: Path, commit: str, runs: Path = RUNS) -> list[str]:
    """Run those that are not done at this commit, and go on after one that fails; returns the names of those."""
    return [command.name for command in commands if not _run(command, out, commit, runs)]


def code_commit() -> str:
    """The last commit that changed what tables depend on."""
    return _git("log", "-1", "--format=%h", "--", *CODE, *NOT_CODE)


def is_done(command: Command, commit: str, runs: Path = RUNS) -> bool:
    """Whether the command has succeeded at this commit, as it stands now, and its table is there."""
    stamp = stamps(runs).get(command.name)
    return (
        stamp is not None
        and (stamp.commit, stamp.command) == (commit, command.shown)
        and (Path("results") / command.table).exists()
    )


def described(command: Command, commit: str, runs: Path = RUNS) -> str:
    """One line: name, state, minutes, needs and the command itself."""
    stamp = stamps(runs).get(command.name)
    state = "done" if is_done(command, commit, runs) else f"last at {stamp.commit}" if stamp else "to do"
    minutes = f"{stamp.minutes:.0f} min" if stamp and stamp.minutes else f"about {command.minutes} min"
    needs = f"  [extra {command.extra}]" if command.extra else ""
    return f"{command.name:18} {state:16} {minutes:13} results/{command.table}: {command.shown}{needs}"


def folders(command: Command, out: Path, commit: str) -> list[str]:
    """Options that name its folders of intermediate results, which belong to the commit."""
    named = [*([(command.work, command.name)] if command.work else []), *command.reads]
    return [text for option, name in named for text in (option, str(out / commit / name))]


def stamps(runs: Path = RUNS) -> dict[str, Stamp]:
    """When and at which commit each command last succeeded, by its name."""
    return {name: Stamp(**stamp) for name, stamp in json.loads(runs.read_text()).items()} if runs.exists() else {}


def _run(command: Command, out: Path, commit: str, runs: Path) -> bool:
    """Whether the command is done at this commit, run where it was not."""
    if is_done(command, commit, runs):
        print(f"{command.name}: done at {commit}")
        return True
    if command.extra and find_spec(INSTALLED_BY[command.extra]) is None:
        print(f"{command.name}: needs pip install 'visadapt[{command.extra}]'")
        return False
    log = out / f"{command.name}.log"
    log.parent.mkdir(parents=True, exist_ok=True)
    print(f"{command.name}: {command.shown}, about {command.minutes} min; log in {log}", flush=True)
    began = time.monotonic()
    with log.open("w") as file:
        ended = subprocess.run(
            [sys.executable, "-m", *command.arguments, *folders(command, out, commit)],
            stdout=file,
            stderr=subprocess.STDOUT,
            check=False,
        )
    minutes = (time.monotonic() - began) / 60
    if ended.returncode:
        print(f"{command.name}: exit status {ended.returncode} after {minutes:.1f} min; see {log}", flush=True)
        return False
    stamp = Stamp(commit, f"{datetime.now(UTC):%Y-%m-%d}", command.shown, round(minutes, 1))
    done = {**stamps(runs), command.name: stamp}
    with replacing(runs) as temporary:
        temporary.write_text(json.dumps({name: asdict(stamp) for name, stamp in sorted(done.items())}, indent=2) + "\n")
    return True


def _git(*arguments: str) -> str:
    return subprocess.run(["git", *arguments], capture_output=True, text=True, check=True).stdout.strip()


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Settings, description=__doc__)))
