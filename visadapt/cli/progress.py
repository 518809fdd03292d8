"""Progress on the terminal, apart from the results."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from visadapt.progress import Report, reporting


@contextmanager
def progress() -> Iterator[Report]:
    """A report of progress on stderr, where everything goes that is printed meanwhile: stdout is for results."""
    with contextlib.redirect_stdout(sys.stderr), reporting() as report:
        yield report
