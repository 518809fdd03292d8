"""Tries damaged files on a reader, many in one process that is allowed so much time and memory for each."""

from __future__ import annotations

import json
import os
import resource
import signal
import tempfile
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from random import Random

from tests.fuzz.readers import READERS

CRASHES = Path(__file__).parents[1] / "crashes"

LONGEST_S = 10
"""s of computation that one input may take, beside the 5 s that HDF5 may take over a damaged one in its own process."""
MOST_BYTES = 2 * 2**30  # more than the reader's process had before
ADDRESS_SPACE = 8 * 2**30


@dataclass(frozen=True)
class Tried:
    """What a reader answered to one input."""

    index: int
    answer: str  # "read", "refused", or what is wrong
    content: bytes

    @property
    def failed(self) -> bool:
        """Whether it is neither read nor refused in one line."""
        return self.answer not in ("read", "refused")


def damaged(name: str, seed: int, index: int) -> tuple[bytes, bool]:
    """Input `index` for a reader, the same for the same seed; and whether a checksum must show what was done to it."""
    return READERS[name].damaged(Random(f"{name} {seed} {index}"))


def tried(name: str, indices: Sequence[int], make: Callable[[int], tuple[bytes, bool]]) -> Iterator[Tried]:
    """What a reader answers to each input, which `make` gives; a process that one ends is followed by another."""
    left = list(indices)
    READERS[name].contents()
    while left:
        answers, ended = _in_a_child(name, left, make)
        for index, answer in zip(left, answers, strict=False):
            yield Tried(index, answer, make(index)[0] if answer not in ("read", "refused") else b"")
        left = left[len(answers) :]
        if ended and left:
            index = left.pop(0)
            what = f"took more than {LONGEST_S} s" if ended == signal.SIGPROF else f"ended the process, status {ended}"
            yield Tried(index, what, make(index)[0])


def _in_a_child(name: str, indices: Sequence[int], make: Callable[[int], tuple[bytes, bool]]) -> tuple[list[str], int]:
    """The answers to the first of some inputs, from a process of its own, and that process's status."""
    with tempfile.TemporaryDirectory() as folder, tempfile.TemporaryFile("w+") as answers:
        if (child := os.fork()) == 0:
            status = 1
            try:
                resource.setrlimit(resource.RLIMIT_AS, (ADDRESS_SPACE, ADDRESS_SPACE))
                resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
                for index in indices:
                    signal.setitimer(signal.ITIMER_PROF, LONGEST_S)  # the signal ends this process
                    content, unsealed = make(index)
                    before = _peak()
                    answer = answered(name, Path(folder), content, unsealed)
                    if grown := _peak() - before > MOST_BYTES:
                        answer = f"took {_peak() - before} bytes of memory"
                    answers.write(json.dumps(answer) + "\n")
                    answers.flush()
                    if grown:
                        break  # the peak is that of this one from now on
                status = 0
            finally:
                os._exit(status)
        status = os.waitpid(child, 0)[1]
        answers.seek(0)
        return [json.loads(line) for line in answers], status


def _peak() -> int:
    """Bytes of memory that this process, or one that it started, had at most."""
    return 1024 * max(resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))


def answered(name: str, folder: Path, content: bytes, unsealed: bool) -> str:
    """Whether a reader reads a file, refuses it in one line that names it, or what else it does."""
    reader = READERS[name]
    path = folder / reader.file
    path.write_bytes(content)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # a warning of Python's is a line that no user understands
            found = reader.read(path)
    except BaseException as error:
        text, chain = str(error), [error]
        while (link := chain[-1].__cause__ or chain[-1].__context__) is not None:
            chain.append(link)
        own = type(error).__module__.partition(".")[0] in ("visadapt", "renderers")
        if not own:
            return f"{type(error).__name__}: {text}"
        if any(isinstance(each, MemoryError) or "allocate memory" in str(each) for each in chain):
            return f"asked for more memory than there is: {text}"
        return "refused" if str(folder) in text and "\n" not in text else f"not one line on the file: {text}"
    if unsealed and isinstance(found, bytes) and found not in reader.contents():
        return "read, but as other than what was written"
    return "read"


def kept(name: str, seed: int, one: Tried) -> Path:
    """The input as a file that a test tries from now on."""
    CRASHES.mkdir(exist_ok=True)
    path = CRASHES / f"{name}-{seed}-{one.index}"
    path.write_bytes(one.content)
    return path


def again(path: Path) -> Tried:
    """What a reader answers to a kept input."""
    name = path.name.partition("-")[0]
    (one,) = tried(name, [0], lambda _: (path.read_bytes(), False))
    return one


def counted(name: str, seed: int, indices: Sequence[int]) -> tuple[Counter[str], list[Tried]]:
    """How many inputs were read, refused and failed, and those that failed."""
    every = list(tried(name, indices, lambda index: damaged(name, seed, index)))
    failed = [one for one in every if one.failed]
    return Counter("failed" if one.failed else one.answer for one in every), failed
