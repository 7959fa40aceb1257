"""The command line: `jvr render`, `jvr fit`, `jvr plan`, `jvr info`, `jvr demo`.

Nothing that takes time is imported before `run` can catch Ctrl-C.
"""

import io
import os
import sys
from collections.abc import Sequence
from typing import Any, NoReturn

from jvr.cli.signals import INTERRUPTED, Terminated, catch, leave, said


def main() -> NoReturn:
    """The entry point of the `jvr` command."""
    catch()
    # Names of files may hold bytes that are no text, and terminals may know no bars.
    if isinstance(sys.stdout, io.TextIOWrapper) and sys.stdout.errors == "strict":
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        status = run(sys.argv[1:])
        if sys.stdout is not None:  # closed by the caller
            sys.stdout.flush()
    except OSError as error:
        status = _unprintable(error)
    if status > 128:
        leave(status)
    sys.exit(status)


def run(arguments: Sequence[str]) -> int:
    """Runs one command line and returns its exit status: 0 done, 2 bad input, 130 Ctrl-C, 143 SIGTERM, 1 anything else.

    What a person can do something about is one line on stderr: bad input, a full disk, an interruption. An error of jvr's own is not
    caught: its traceback is what a report needs.
    """
    try:
        import typer

        # The public name of their common base class differs between versions of typer.
        usage_error: Any = typer.BadParameter.__mro__[1]
        from jvr.cli.app import app
        from jvr.cli.inputs import BadInput, Interrupted, explain, system_problem, usage_problem

        try:
            status = app(list(arguments) or ["--help"], prog_name="jvr", standalone_mode=False)
            if status == INTERRUPTED:  # typer's word for a KeyboardInterrupt
                raise KeyboardInterrupt
            return status if isinstance(status, int) else 0
        except BadInput as error:
            return explain(str(error), 2)
        except Interrupted as error:
            return explain(str(error), error.status)
        except usage_error as error:
            return explain(usage_problem(error), 2)
        except OSError as error:
            return explain(system_problem(error), 1)
    except (KeyboardInterrupt, Terminated) as error:
        status = error.status if isinstance(error, Terminated) else INTERRUPTED
        print(f"jvr: {said(status)}", file=sys.stderr, flush=True)
        return status


def _unprintable(error: OSError) -> int:
    """The status where the output took no more; what is left of it goes nowhere, or the interpreter would try again."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    if not isinstance(error, BrokenPipeError):
        print(f"jvr: stdout: {error.strerror}", file=sys.stderr)
    return 1


__all__ = ["main", "run"]
