"""A process of its own for each renderer, so that memory is its own and libraries do not meet.

The parent says when to work, so that renderers can take turns; the clock runs in the worker, around the work alone.
"""

import importlib
import os
import subprocess
import sys
import time
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from types import TracebackType
from typing import Any

from benchmarks.peers import memory
from benchmarks.peers.settings import THREADS

# What a worker is called: its module here, and the class that it makes one of.
RENDERERS = {
    "jvr": ("ours", "Renderer"),
    "jvr_packed": ("ours", "Packed"),
    "vtk": ("vtk_mappers", "Renderer"),
    "vtk_gpu": ("vtk_mappers", "GpuRenderer"),
    "compiled": ("compiled", "Renderer"),
    "torch": ("grid_sample", "Renderer"),
    "mitsuba": ("paths", "Renderer"),
}
KINDS = {**RENDERERS, "reference": ("ours", "Reference"), "fit": ("fits", "Fit"), "torch_views": ("grid_sample", "Views")}
ENVIRONMENT = {"reference": {"JAX_ENABLE_X64": "1"}, "vtk_gpu": {"LP_NUM_THREADS": str(THREADS)}}


class Absent(Exception):
    """A renderer that is not installed."""


class Worker:
    """A renderer in its own process, a context manager: `load` makes it, `call` runs a method of it.

    Has the attribute `version`. **Raises** `Absent` where the renderer is not installed, and from any method `RuntimeError` with the
    text of what went wrong there.
    """

    def __init__(self, name: str):
        ours, theirs = Pipe()
        command = [sys.executable, "-m", "benchmarks.peers.worker", name, str(theirs.fileno())]
        environment = {**os.environ, **ENVIRONMENT.get(name, {})}
        self.process = subprocess.Popen(command, pass_fds=[theirs.fileno()], env=environment)
        theirs.close()
        self.name, self.pipe = name, ours
        try:
            self.version: str = self._answer()
        except BaseException:
            self.close()
            raise

    def load(self, *arguments: Any) -> "Worker":
        """Makes the renderer, of these arguments."""
        self._ask("load", arguments)
        return self

    def call(self, method: str, *arguments: Any) -> Any:
        return self._ask(method, arguments)[0]

    def seconds(self, method: str, *arguments: Any) -> float:
        """Wall seconds of the method."""
        return self._ask(method, arguments)[1]

    def peak(self, method: str, *arguments: Any) -> int:
        """The most memory in bytes, beyond that of the imported libraries, while the method runs. The scene is part of it; what
        compilation took is not, once the method has run before."""
        return self._ask(method, arguments, True)[2]

    def close(self) -> None:
        self.pipe.close()
        self.process.wait()

    def _ask(self, method: str, arguments: tuple[Any, ...], memory: bool = False) -> Any:
        self.pipe.send((method, arguments, memory))
        return self._answer()

    def _answer(self) -> Any:
        try:
            failure, answer = self.pipe.recv()
        except EOFError:
            raise RuntimeError(f"the process of {self.name} ended") from None
        if failure == "ImportError":
            raise Absent(answer)
        if failure:
            raise RuntimeError(f"{failure}: {answer}")
        return answer

    def __enter__(self) -> "Worker":
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, traceback: TracebackType | None) -> None:
        self.close()


def limit_to(threads: int) -> None:
    """Keeps this process to a number of cores; XLA, unlike the others, cannot be told a number of threads."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:threads])


def main() -> None:
    """Sends the version, then answers the parent until it hangs up; each answer is `(kind of failure or None, answer or text)`."""
    name, pipe = sys.argv[1], Connection(int(sys.argv[2]))
    limit_to(THREADS)
    # A library may write to stdout, which is the parent's JSON.
    os.dup2(2, 1)
    module, kind = KINDS[name]
    try:
        loaded = importlib.import_module(f"benchmarks.peers.{module}")
        if hasattr(loaded, "jvr"):
            loaded.jvr.use_all_cores()
        pipe.send((None, loaded.version()))
    except ImportError as error:
        pipe.send(("ImportError", str(error)))
        return
    _serve(pipe, getattr(loaded, kind))


def _serve(pipe: Connection, kind: Any) -> None:
    base, target = memory.resident(), None
    while True:
        try:
            method, arguments, measure = pipe.recv()
        except EOFError:
            return
        try:
            if method == "load":
                target, answer = kind(*arguments), None
            else:
                if measure:
                    memory.reset_peak()
                began = time.perf_counter()
                result = getattr(target, method)(*arguments)
                answer = (result, time.perf_counter() - began, memory.peak() - base if measure else 0)
            pipe.send((None, answer))
        except Exception as error:
            pipe.send((type(error).__name__, str(error)))
        # What was sent and answered would count as the renderer's memory.
        arguments = result = answer = None


if __name__ == "__main__":
    main()
