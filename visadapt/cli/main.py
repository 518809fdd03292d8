"""The command `visadapt`: one module a subcommand, and what all of them answer to bad input and interruption."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence

from visadapt.cli import adapt, diagnose, effects, renderer, score, train

DONE, BAD_INPUT, INTERRUPTED = 0, 2, 130
"""Exit statuses; 2 is argparse's own, 130 a shell's."""

COMMANDS = (diagnose, effects, renderer, train, adapt, score)
"""Each has `add`, which adds its parser and sets `run`, which carries it out. All that loads slowly, loads in `run`."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command: 0 done; 2 bad input, described by one line on stderr; 130 interrupted."""
    parser = argparse.ArgumentParser(
        prog="visadapt", description=(sys.modules["visadapt"].__doc__ or "").partition("\n")[0]
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    for command in COMMANDS:
        command.add(commands)
    options = parser.parse_args(arguments)
    try:
        options.run(options)
        sys.stdout.flush()
    except KeyboardInterrupt:
        print("visadapt: interrupted; run the same command to go on", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:
        # Whoever read the output has read enough, as `head` does; Python would complain once more at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except Exception as error:
        if not _is_answer(error):
            raise
        print(f"visadapt: {error}", file=sys.stderr)
        return BAD_INPUT
    return DONE


def _is_answer(error: Exception) -> bool:
    """Whether its message is for whoever runs the command: those of our own exceptions and of the system's are."""
    return isinstance(error, OSError) or type(error).__module__.partition(".")[0] in ("visadapt", "renderers")
