"""Kills `visadapt train`, `adapt` and `diagnose` at random moments: `python -m tests.kills --times 20`.

Each is killed (SIGKILL) at a random moment of its run and started again. It must end with the files of a run that was
left alone, equal byte for byte, and no others.
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

from tests.recorded import a_run, write

COMMAND = "import sys; from visadapt.cli.main import main; sys.exit(main())"
TRAIN = ("train", "--system", "cartpole", "--iterations")
RIG = """import visadapt as va


def pushed():
    return va.SyntheticTarget(va.constant_force(1.0))
"""
ITERATIONS = 20


def main() -> int:
    """0 where every killed run ends as one that was left alone."""
    parser = argparse.ArgumentParser(prog="python -m tests.kills", description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--times", type=int, default=20, help="how often each command is killed (default: 20)")
    parser.add_argument("--seed", type=int, default=0, help="of the moments (default: 0)")
    options = parser.parse_args()
    moments, failed = random.Random(options.seed), 0
    with TemporaryDirectory() as temporary:
        folder = Path(temporary)
        every = commands(folder)
        for name, command in every.items():
            began = time.monotonic()
            whole = result(folder / name, command)
            duration = time.monotonic() - began
            print(f"{name}: {duration:.1f} s, {len(whole)} files", flush=True)
            assert whole, f"visadapt {' '.join(command)} wrote nothing"
            for k in range(options.times):
                moment = moments.uniform(0, duration)
                kill(folder / f"{name}-{k}", command, moment)
                found = result(folder / f"{name}-{k}", command)
                differing = sorted(file for file in {*whole, *found} if whole.get(file) != found.get(file))
                if differing:
                    failed += 1
                    print(f"{name}, killed after {moment:.2f} s: other {', '.join(differing)}", flush=True)
    print(f"{failed} of {options.times * len(every)} killed runs ended otherwise")
    return int(failed > 0)


def commands(inputs: Path) -> dict[str, Sequence[str]]:
    """The three commands, with files in `inputs` that they read; they write into the current folder."""
    policy, recording = str(inputs / "policy.safetensors"), str(write(inputs / "recording.csv", a_run(0.2, 1e-3)))
    (inputs / "killed_rig.py").write_text(RIG)
    subprocess.run([sys.executable, "-c", COMMAND, *TRAIN, "3", "--out", policy], check=True)
    target = ("--target", "killed_rig:pushed", "--samples", "40", "--round", "20", "--iterations", f"{ITERATIONS}")
    return {
        "train": (*TRAIN, f"{ITERATIONS}", "--out", "policy.safetensors"),
        "adapt": ("adapt", "--policy", policy, *target, "--out", "run"),
        "diagnose": ("diagnose", "--system", "cartpole", recording, "--json", "found.json", "--report", "report.html"),
    }


def start(folder: Path, command: Sequence[str]) -> subprocess.Popen[bytes]:
    """The command, begun in a folder, in a process group of its own."""
    folder.mkdir(exist_ok=True)
    paths = os.pathsep.join([str(folder.parent), os.environ.get("PYTHONPATH", "")])
    return subprocess.Popen(
        [sys.executable, "-c", COMMAND, *command],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": paths},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )


def kill(folder: Path, command: Sequence[str], moment: float) -> None:
    """Begin the command and kill it after `moment` s."""
    begun = start(folder, command)
    time.sleep(moment)
    os.killpg(begun.pid, signal.SIGKILL)
    begun.wait()


def result(folder: Path, command: Sequence[str]) -> dict[str, bytes]:
    """What the command, run to its end, leaves in its folder."""
    start(folder, command).wait()
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


if __name__ == "__main__":
    sys.exit(main())
