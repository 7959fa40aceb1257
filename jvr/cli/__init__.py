"""The command line: `jvr render`, `jvr fit`, `jvr plan`, `jvr info`, `jvr demo`."""

import sys
from collections.abc import Sequence
from typing import Any


def main() -> None:
    """The entry point of the `jvr` command."""
    sys.exit(run(sys.argv[1:]))


def run(arguments: Sequence[str]) -> int:
    """Runs one command line and returns its exit status: 0 done, 2 bad input, 1 anything else.

    Bad input is one line on stderr. An error of jvr's own is not caught: its traceback is what a report needs.
    """
    import typer

    # The public name of their common base class differs between versions of typer.
    usage_error: Any = typer.BadParameter.__mro__[1]
    from jvr.cli.app import app
    from jvr.cli.inputs import BadInput, Interrupted, explain, usage_problem

    try:
        status = app(list(arguments) or ["--help"], prog_name="jvr", standalone_mode=False)
        return status if isinstance(status, int) else 0
    except BadInput as error:
        return explain(str(error), 2)
    except Interrupted as error:
        return explain(str(error), 1)
    except (typer.Abort, KeyboardInterrupt):
        return explain("interrupted", 1)
    except usage_error as error:
        return explain(usage_problem(error), 2)


__all__ = ["main", "run"]
