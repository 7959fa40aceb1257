"""How a segment is integrated: the choices that `Settings(quadrature=...)` takes."""

import abc

import equinox as eqx


class AbstractQuadrature(eqx.Module):
    """A rule for one segment. Static, without arrays."""

    @property
    @abc.abstractmethod
    def explanation(self) -> str:
        """What the rule does, for `jvr.plan`."""


class Midpoint(AbstractQuadrature):
    """The midpoint rule, the scalar at the middle of a segment for all of it: order 2 in the step where the transfer function is smooth,
    one resampling a segment. Peaks of the transfer function that the scalar passes between two samples are missed. The default."""

    @property
    def explanation(self) -> str:
        return "a segment has the colour and extinction of its midpoint"


class PreIntegrated(AbstractQuadrature):
    """Pre-integration: the scalar goes linearly from the front of a segment to its back, and extinction and emission are integrated over
    all values between (`jvr.model.preintegration`): thin peaks are seen, at two resamplings a segment.

    **Arguments:** `parts`: how many parts of a segment its self-attenuation takes apart, order 4. Needs a `LinearTransfer` or a
    `LutTransfer`. **Raises** `ValueError` where `parts` is not a positive integer.
    """

    parts: int = eqx.field(static=True, default=1)

    def __check_init__(self):
        if isinstance(self.parts, bool) or not isinstance(self.parts, int) or self.parts < 1:
            raise ValueError(f"PreIntegrated parts must be a positive whole number, not {self.parts!r}")

    @property
    def explanation(self) -> str:
        return f"segments are integrated between the scalars at their ends, self-attenuation in {self.parts} parts"
