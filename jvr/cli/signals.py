"""Ctrl-C and SIGTERM: one line, the right status, and nothing half written, whatever the process is doing."""

import contextlib
import os
import signal
import sys
import threading
import time
from types import FrameType
from typing import NoReturn

# Seconds for what runs to notice, unwind and say what it has kept.
GRACE = 10.0


class Terminated(SystemExit):
    """SIGTERM or SIGHUP, raised where the process is, with the exit status."""

    def __init__(self, status: int):
        super().__init__(status)
        self.status = status


def status_of(number: int) -> int:
    """What a shell says of a command that a signal ended."""
    return 128 + number


INTERRUPTED = status_of(signal.SIGINT)


def said(status: int) -> str:
    return "interrupted" if status == INTERRUPTED else "terminated"


def catch() -> None:
    """From here on a signal ends the process in good order: it raises `KeyboardInterrupt` or `Terminated`.

    Where that does not get through, since a compiler is busy, or a callback of a library swallows what is raised in it, the process ends
    after `GRACE` seconds all the same. For the main thread.
    """
    for name in ("SIGINT", "SIGTERM", "SIGHUP"):
        if hasattr(signal, name) and signal.getsignal(getattr(signal, name)) is not signal.SIG_IGN:
            signal.signal(getattr(signal, name), _handle)
    reading, writing = os.pipe()
    os.set_blocking(writing, False)
    # Written to by the system's handler, while Python's waits for the end of a call.
    signal.set_wakeup_fd(writing, warn_on_full_buffer=False)
    threading.Thread(target=_watch, args=(reading,), daemon=True, name="signals").start()


def leave(status: int) -> NoReturn:
    """Ends the process at once: the interpreter would wait for threads that compute what nobody wants any more."""
    from jvr.atomic import remove_unfinished

    remove_unfinished()
    if sys.stderr is not None and sys.stderr.isatty():
        os.write(2, b"\x1b[?25h")  # a moving sign of life hides the cursor
    os._exit(status)


def _handle(number: int, frame: FrameType | None) -> None:
    status = status_of(number)
    if _must_not_raise(frame):
        _say(status)
        leave(status)
    if status == INTERRUPTED:
        raise KeyboardInterrupt
    raise Terminated(status)


def _must_not_raise(frame: FrameType | None) -> bool:
    """Whether the process is in the middle of an import, where an exception aborts libraries in C++, or in what is called by the collector
    of garbage, where it is printed and forgotten."""
    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib") or frame.f_code.co_name in ("__del__", "_xla_gc_callback"):
            return True
        frame = frame.f_back
    return False


def _watch(reading: int) -> None:
    while (number := os.read(reading, 1)[0]) not in (signal.SIGINT, signal.SIGTERM, getattr(signal, "SIGHUP", None)):
        pass
    time.sleep(GRACE)
    _say(status_of(number))
    leave(status_of(number))


def _say(status: int) -> None:
    # Not through `sys.stderr`, which the thread that is interrupted may be in the middle of.
    with contextlib.suppress(OSError):
        os.write(2, f"jvr: {said(status)}\n".encode())
