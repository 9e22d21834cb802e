"""The command line: `shapeenh render MESH -o out.png`."""

from __future__ import annotations

import argparse
import sys
import warnings

from shapeenh.cli import fit, lines, render
from shapeenh.cli.terminal import one_line, show_warning, use_compilation_cache
from shapeenh.cli.values import UsageError

COMMANDS = (render, lines, fit)


class _Parser(argparse.ArgumentParser):
    def error(self, message):
        raise UsageError(message)


def main(argv: list[str] | None = None) -> int:
    """Entry point; returns the exit code: 0, or 2 for wrong input."""
    parser = _Parser(prog="shapeenh", description="Makes the shape of things visible.")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for command in COMMANDS:
        command.add_parser(commands)
    with warnings.catch_warnings():
        warnings.simplefilter("always", UserWarning)
        warnings.showwarning = show_warning
        try:
            arguments = parser.parse_args(argv)
            use_compilation_cache()
            arguments.run(arguments)
        except (UsageError, ValueError, OSError) as error:
            print(f"shapeenh: error: {one_line(error)}", file=sys.stderr)
            return 2
        except MemoryError:
            print("shapeenh: error: not enough memory; try a smaller --size", file=sys.stderr)
            return 2
        except KeyboardInterrupt:
            return 130
    return 0
