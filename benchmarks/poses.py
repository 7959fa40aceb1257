"""What a step towards unknown poses costs, in pictures of the same views."""

from typing import Any

import jax
import numpy as np

import jvr
from benchmarks.timing import median, ratio, seconds
from jvr.fitting.evaluator import Evaluator
from jvr.fitting.groups import Group
from jvr.fitting.losses import SquaredError
from jvr.fitting.observations import is_mostly_empty, observe
from jvr.fitting.problem import Problem
from jvr.fitting.unknowns import ExposedModel, choose_unknowns
from jvr.fitting.views import Views


def pose_step(scene: jvr.Scene, cameras: Any, images: Any, settings: jvr.Settings, repeats: int = 7) -> dict[str, float]:
    """Seconds of the normal equations of all six unknowns of every view, which is what a step of Levenberg-Marquardt takes, over those of
    plain pictures of the views, in turns."""
    model = ExposedModel(scene.current(), None, Views.at_rest(tuple(cameras)))
    chosen = choose_unknowns(model, lambda m: m.views and m.views.motions, bounds=jvr.LevenbergMarquardt().bounds)
    problem = Problem(model, chosen, settings, SquaredError(), (), None, is_mostly_empty(scene, settings))
    observations = observe(scene, cameras, [np.asarray(image) for image in images], None, settings, unknown=range(len(cameras)))
    evaluator, at = Evaluator((Group(problem, observations),), cameras, None), chosen.unconstrained_from_model(model)
    draw = jax.jit(jvr.render)
    pictures = lambda: [draw(scene, camera, settings).rgb for camera in cameras]
    times = seconds({"step": lambda: evaluator.expand(-1, at), "pictures": pictures}, repeats)
    return {
        "step_seconds": median(times, "step"),
        "pictures_seconds": median(times, "pictures"),
        "step_over_pictures": ratio(times, "step", "pictures"),
    }
