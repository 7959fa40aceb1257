"""The iteration of a fit: steps of a solver with their history, which is shown and saved on the way."""

import dataclasses
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from jvr.fitting import checkpoint
from jvr.fitting.evaluator import Evaluator
from jvr.fitting.least_squares import ChunkedLeastSquares
from jvr.fitting.problem import Problem
from jvr.fitting.result import Iteration
from jvr.fitting.solvers import AbstractSolver
from jvr.types import Outcome

# Relative decrease at which a stage on the way ends.
ROUGH = 0.02


class Checkpoint(NamedTuple):
    """A file that a fit saves itself in, and goes on from where it `resumes`; `mark`: what it depends on."""

    path: Path
    mark: checkpoint.Fingerprint
    resumes: bool

    @property
    def is_there(self) -> bool:
        return self.resumes and self.path.exists()


class Descent:
    """Steps of a solver, at most `max_steps` of them in all its runs, with their `history` and the `outcome` of the last run."""

    def __init__(self, solver: AbstractSolver, max_steps: int, began: float, progress: bool | Callable[[Iteration], None] | None):
        self.solver, self.max_steps, self.began = solver, max_steps, began
        self.history: list[Iteration] = []
        self.outcome: Outcome | None = None
        self._progress, self._bar = progress, None

    def __enter__(self) -> "Descent":
        if not callable(self._progress) and (self._progress or (self._progress is None and sys.stderr.isatty())):
            from rich.console import Console
            from rich.progress import Progress

            self._bar = Progress(console=Console(stderr=True))
            self._bar.start()
            self._task = self._bar.add_task("fit", total=self.max_steps)
        return self

    def __exit__(self, *raised: Any) -> None:
        if self._bar is not None:
            self._bar.stop()

    def run(
        self,
        evaluator: Evaluator,
        problem: Problem,
        start: Float[Array, "unknowns"] | None = None,
        file: Checkpoint | None = None,
        share: float = 1.0,
    ) -> Float[Array, "unknowns"]:
        """The values at the end of an iteration from `start`, by default the values of the problem's own model. `share`: of all rays that
        the problem has; a problem that does not have all is a stage on the way, which need not be found to the last digit."""
        unknowns, functions, solver = problem.unknowns, evaluator.functions, self.solver
        if share < 1 and isinstance(solver, ChunkedLeastSquares):
            solver = dataclasses.replace(solver, rtol=max(solver.rtol, ROUGH))
        state = solver.init(functions, unknowns.unconstrained_from_model(problem.model) if start is None else start)
        if file is not None and file.is_there:
            state, rows = checkpoint.load(file.path, state, file.mark)
            self.history = [Iteration(**row) for row in rows]
            self.began -= self.history[-1].seconds if self.history else 0.0
        self.outcome = solver.outcome(state)
        while self.outcome is None and len(self.history) < self.max_steps:
            state = solver.step(functions, state)
            self.history.append(self._iteration(evaluator, state, share))
            if file is not None:
                checkpoint.save(file.path, state, [entry._asdict() for entry in self.history], file.mark)
            self._show(self.history[-1])
            self.outcome = solver.outcome(state)
        unconstrained, _ = solver.iterate(state)
        return unknowns.values_from_unconstrained(jnp.asarray(unconstrained), problem.model)

    def _iteration(self, evaluator: Evaluator, state: Any, share: float) -> Iteration:
        unconstrained, loss = self.solver.iterate(state)
        level = int(getattr(state, "level", -1))
        psnr = evaluator.psnr(unconstrained, loss, getattr(state, "normal", None))
        seconds = time.perf_counter() - self.began
        return Iteration(len(self.history) + 1, loss, psnr, seconds, share * evaluator.fraction(level))

    def _show(self, entry: Iteration) -> None:
        if callable(self._progress):
            self._progress(entry)
        elif self._bar is not None:
            words = f"step {entry.step}  loss {entry.loss:.3e}  PSNR {entry.psnr:.1f} dB"
            self._bar.update(self._task, completed=entry.step, description=words)
