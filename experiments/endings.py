"""How a script that can be resumed ends where it cannot go on, or is interrupted: with one line, not a traceback."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from visadapt.targets import TargetError


@contextmanager
def ends_in_one_line(script: str) -> Iterator[None]:
    """Turn errors that whoever runs `script` can do something about, and interrupts, into a line on stderr."""
    try:
        yield
    except (TargetError, ValueError, OSError) as error:
        raise SystemExit(f"{script}: {error}") from error
    except KeyboardInterrupt:
        raise SystemExit("interrupted: run it again to go on") from None
