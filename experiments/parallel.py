"""The jobs of an experiment, such as its seeds, in processes of this machine, or on the nodes of a Ray cluster."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Literal, Protocol, TypeVar

Job = TypeVar("Job", bound=tuple[object, ...])
Result = TypeVar("Result")

Jobs = int | Literal["ray"]
"""Processes of this machine; or "ray": as many as the CPUs of the Ray cluster that RAY_ADDRESS or a running `ray start`
names, or else of this machine."""


class Parallel(Protocol):
    """Settings that say how many jobs run at once."""

    @property
    def jobs(self) -> Jobs:
        """Processes, or "ray"."""
        ...


def in_processes(work: Callable[..., Result], settings: Parallel, jobs: Sequence[Job]) -> dict[Job, Result]:
    """What `work(settings, *job)` returns for every job; `work` stands in a module, where new processes find it.

    On a Ray cluster a job whose node is lost begins again on another one, and goes on after what it kept in its folder:
    repository, Python environment and folders must be at the same place, on a file system that all nodes share.
    """
    if settings.jobs == "ray":
        return dict(zip(jobs, _on_ray(work, settings, jobs), strict=True))
    context = multiprocessing.get_context("spawn")  # a fork would inherit the threads of torch
    with ProcessPoolExecutor(settings.jobs, mp_context=context) as pool:
        found = pool.map(work, [settings] * len(jobs), *zip(*jobs, strict=True))
        return dict(zip(jobs, found, strict=True))


def _on_ray(work: Callable[..., Result], settings: Parallel, jobs: Sequence[Job]) -> list[Result]:
    try:
        import ray
    except ModuleNotFoundError as error:
        raise SystemExit("--jobs ray needs Ray: pip install 'visadapt[ray]'") from error
    here = Path.cwd()
    ray.init(runtime_env={"env_vars": {"PYTHONPATH": str(here)}}, ignore_reinit_error=True)
    task = ray.remote(num_cpus=1)(_in_folder)
    found: list[Result] = ray.get([task.remote(here, work, settings, job) for job in jobs])
    return found


def _in_folder(folder: Path, work: Callable[..., Result], settings: Parallel, job: Job) -> Result:
    os.chdir(folder)
    return work(settings, *job)
