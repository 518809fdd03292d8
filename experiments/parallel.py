"""The jobs of an experiment, such as its seeds, in processes side by side."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from typing import Protocol, TypeVar

Job = TypeVar("Job", bound=tuple[object, ...])
Result = TypeVar("Result")


class Parallel(Protocol):
    """Settings that say how many jobs run at once."""

    @property
    def jobs(self) -> int:
        """Processes."""
        ...


def in_processes(work: Callable[..., Result], settings: Parallel, jobs: Sequence[Job]) -> dict[Job, Result]:
    """What `work(settings, *job)` returns for every job; `work` stands in a module, where new processes find it."""
    context = multiprocessing.get_context("spawn")  # a fork would inherit the threads of torch
    with ProcessPoolExecutor(settings.jobs, mp_context=context) as pool:
        found = pool.map(work, [settings] * len(jobs), *zip(*jobs, strict=True))
        return dict(zip(jobs, found, strict=True))
