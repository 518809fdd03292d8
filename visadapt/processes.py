"""Work shared out among processes, for tensor operations so small that threads do not speed them up."""

from __future__ import annotations

import io
import multiprocessing
import pickle
import signal
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from multiprocessing.connection import Connection
from typing import Any, TypeVar

import torch

from visadapt.effects.base import EFFECTS, Effect, with_table

ENDING = (signal.SIGINT, signal.SIGTERM)

Result = TypeVar("Result")
Work = Callable[[Sequence[int]], Sequence[Result]]
"""Gives a result for each of its indices, which does not depend on the others."""


@contextmanager
def one_thread() -> Iterator[None]:
    """Operations of torch take one thread: they are too small for more, and processes share the work."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def shared_out(work: Work[Result], count: int, jobs: int) -> list[Result]:
    """The results of `work` for indices 0 to `count` - 1, computed in at most `jobs` processes.

    Processes are forked: they see what this one has made so far, and what they change is lost but for the results.
    Where the operating system cannot fork, this process does all the work. An error in any process is raised here.

    >>> shared_out(lambda indices: [10 * index for index in indices], 5, jobs=2)
    [0, 10, 20, 30, 40]
    """
    jobs = min(jobs, count) if "fork" in multiprocessing.get_all_start_methods() else 1
    if jobs < 2:
        return list(work(range(count)))
    context = multiprocessing.get_context("fork")
    # Neighbours may be alike in cost, so each process takes every `jobs`-th.
    shares = [range(first, count, jobs) for first in range(jobs)]
    started = []
    for share in shares[1:]:
        receiver, sender = context.Pipe(duplex=False)
        process = context.Process(target=_run, args=(work, share, sender), daemon=True)
        # An exception in a hook of the fork would be lost, so signals wait until the fork is done.
        before = signal.pthread_sigmask(signal.SIG_BLOCK, ENDING)
        try:
            process.start()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
        sender.close()
        started.append((process, receiver))
    results: list[Result | None] = [None] * count
    results[shares[0].start :: jobs] = work(shares[0])
    for share, (process, receiver) in zip(shares[1:], started, strict=True):
        # Pickled by hand: sent as they are, tensors would pass through shared memory, of which there may be little.
        found = pickle.loads(receiver.recv_bytes())
        process.join()
        if isinstance(found, BaseException):
            raise found
        results[share.start :: jobs] = found
    return results  # type: ignore[return-value]  # every index is in one share


def _run(work: Work[Result], share: Sequence[int], sender: Connection) -> None:
    # An interrupt from the keyboard reaches every process; the one that shares out the work ends the others.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, ENDING)
    try:
        found: object = list(work(share))
    except Exception as error:
        found = error
    stream = io.BytesIO()
    _Pickler(stream).dump(found)
    sender.send_bytes(stream.getvalue())


class _Pickler(pickle.Pickler):
    """Pickles effects by name: those of a system of one's own are in no module."""

    def reducer_override(self, obj: Any) -> Any:
        if isinstance(obj, type) and issubclass(obj, Effect) and getattr(obj, "name", "") in EFFECTS:
            named = (obj.name, obj.table)
            if with_table(*named) is obj:
                return with_table, named
        return NotImplemented
