"""What chooses samples is an integrator: `jvr.rendering.integrator`."""

from jvr.names import moved

MOVED = {
    "AbstractSampling": "jvr.rendering.integrator.AbstractIntegrator",
    "Refinement": "jvr.Refinement",
    "Slices": "jvr.Slices",
    "Uniform": "jvr.Uniform",
}
__getattr__ = moved(__name__, MOVED)
