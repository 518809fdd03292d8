"""A full disk, pretended in a process of its own: a limit on the size of a file stands for it."""

import multiprocessing
import resource
from collections.abc import Callable

MOST_BYTES = 4096


def error_on_a_full_disk(write: Callable[[], object]) -> str:
    """What `write` says in its OSError where no file may grow beyond MOST_BYTES."""
    here, there = multiprocessing.Pipe(duplex=False)

    def limited() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (MOST_BYTES, MOST_BYTES))
        try:
            write()
        except OSError as error:
            there.send(str(error))

    process = multiprocessing.get_context("fork").Process(target=limited)
    process.start()
    there.close()
    process.join()
    assert here.poll(), "nothing was refused"
    return here.recv()
