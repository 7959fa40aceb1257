"""The command line: `jvr render`, `jvr fit`, `jvr plan`, `jvr info`, `jvr demo`.

Nothing that takes time is imported before `run` can catch Ctrl-C.
"""

import os
import signal
import sys
from collections.abc import Sequence
from typing import Any, NoReturn

# What a shell says of a command that a signal ended: 128 and its number.
INTERRUPTED, TERMINATED, CLOSED_PIPE = 130, 143, 141


class Terminated(KeyboardInterrupt):
    """SIGTERM: what unwinds on Ctrl-C unwinds here, too."""


def main() -> NoReturn:
    """The entry point of the `jvr` command."""
    signal.signal(signal.SIGTERM, _terminate)
    try:
        status = run(sys.argv[1:])
        sys.stdout.flush()
    except OSError as error:
        status = _unprintable(error)
    except KeyboardInterrupt as error:
        status = _ended(error)
    if status in (INTERRUPTED, TERMINATED):
        # At once: the interpreter would wait for threads that compute what nobody wants any more.
        os._exit(status)
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
            return status if isinstance(status, int) else 0
        except BadInput as error:
            return explain(str(error), 2)
        except Interrupted as error:
            return explain(str(error), _status(error.__cause__))
        except typer.Abort:
            return explain("interrupted", INTERRUPTED)
        except usage_error as error:
            return explain(usage_problem(error), 2)
        except BrokenPipeError:
            raise
        except OSError as error:
            return explain(system_problem(error), 1)
    except KeyboardInterrupt as error:
        return _ended(error)


def _terminate(*_: Any) -> NoReturn:
    raise Terminated


def _status(error: BaseException | None) -> int:
    return TERMINATED if isinstance(error, Terminated) else INTERRUPTED


def _ended(error: KeyboardInterrupt) -> int:
    status = _status(error)
    print(f"jvr: {'terminated' if status == TERMINATED else 'interrupted'}", file=sys.stderr)
    return status


def _unprintable(error: OSError) -> int:
    """The status where the output took no more; what is left of it goes nowhere, or the interpreter would try again."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    if isinstance(error, BrokenPipeError):
        return CLOSED_PIPE
    print(f"jvr: stdout: {error.strerror}", file=sys.stderr)
    return 1


__all__ = ["main", "run"]
