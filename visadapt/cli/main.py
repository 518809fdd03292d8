"""The command `visadapt`: one module for each subcommand; here, how all of them end on bad input or interruption."""

from __future__ import annotations

import argparse
import importlib
import io
import os
import signal
import sys
from collections.abc import Sequence
from contextlib import suppress
from typing import Any, NoReturn

from visadapt.cli import arguments as asked
from visadapt.cli.user_code import own_line

COMMANDS = {
    asked.diagnose: "where a rig departs from the simulator, which effects cause it, and how much they explain",
    asked.effects: "the effects that a diagnosis can name: equations, parameters, units, ranges",
    asked.check: "whether a class in a file of yours is a system that visadapt can work with, and what it lacks",
    asked.renderer: "learn from a camera's frames how a cart-pole looks in each state",
    asked.train: "train a policy in the simulator, with the effects of a diagnosis if there are any",
    asked.adapt: "adapt a policy to a target from few counted samples of it",
    asked.export: "write a policy as ONNX, which a machine runs without PyTorch",
    asked.score: "run a policy on a target: its score, failed episodes counted apart, and a film",
}
"""Each subcommand's arguments, and what it does; it is carried out by `run` of the module of its name."""

LONGEST_MESSAGE = 1000  # Characters

RESUMED = ("adapt", "train", "renderer")  # Subcommands that go on where an interrupted run ended


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command: 0 done; 2 bad input, described by one line on stderr; 130 interrupted."""
    command = ""
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # as stderr: a file's name may not fit the encoding
    with suppress(ValueError):  # outside the main thread
        # As after an interrupt, so that nothing half-written is left.
        signal.signal(signal.SIGTERM, _terminate)
    try:
        options = _parser().parse_args(arguments)
        command = options.command
        importlib.import_module("visadapt.cli.files").check_files(options)
        del options.command  # what is left are the settings of a run
        importlib.import_module(f"visadapt.cli.{command}").run(options)
        sys.stdout.flush()
    except KeyboardInterrupt:
        resumes = "; run the same command to go on" if command in RESUMED else ""
        print(f"visadapt: interrupted{resumes}", file=sys.stderr)
        return 130  # as of a shell
    except _Terminated:
        raise
    except BrokenPipeError:
        # The reader closed the pipe, as `head` does; without this, Python would complain at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except (Exception, SystemExit) as error:
        # The messages of our own exceptions, of the system's and of the user's code are for whoever runs the command.
        message: object = error
        if type(error).__module__.partition(".")[0] not in ("visadapt", "renderers"):
            message = own_line(error) or (error if isinstance(error, OSError) else None)
            if message is None:
                raise
        print(f"visadapt: {in_one_line(message)}", file=sys.stderr)
        return 2  # argparse's own
    return 0


class _Terminated(SystemExit):
    """The process was asked to end, whatever it was doing: no exit of the user's code."""


def _terminate(number: int, _: object) -> None:
    raise _Terminated(128 + number)


class _Parser(argparse.ArgumentParser):
    """The usual parser, which drops nothing and guesses nothing, and prints no control characters of an argument."""

    def __init__(self, **named: Any) -> None:
        super().__init__(allow_abbrev=False, **named)
        self.register("action", None, _Once)

    def error(self, message: str) -> NoReturn:
        super().error(in_one_line(message))


class _Once(argparse.Action):
    """Keeps the value of an option that may be given once; a second value would replace the first unnoticed."""

    given = False

    def __call__(
        self, parser: argparse.ArgumentParser, namespace: argparse.Namespace, values: Any, option: str | None = None
    ) -> None:
        if self.given:
            raise argparse.ArgumentError(self, "given twice; one is right")
        self.given = True
        setattr(namespace, self.dest, values)


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="visadapt", description=(sys.modules["visadapt"].__doc__ or "").partition("\n")[0])
    commands = parser.add_subparsers(required=True, metavar="COMMAND", dest="command")
    for add_arguments, does in COMMANDS.items():
        add_arguments(commands.add_parser(add_arguments.__name__, help=does))
    return parser


def in_one_line(message: object) -> str:
    """A message in one line without control characters, which a name or a cell may hold; a very long one is cut in
    the middle."""
    text = "".join(each if each.isprintable() else each.encode("unicode_escape").decode() for each in str(message))
    half = LONGEST_MESSAGE // 2
    return text if len(text) <= LONGEST_MESSAGE else f"{text[:half]} ... {text[-half:]}"
