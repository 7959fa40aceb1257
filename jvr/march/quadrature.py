"""How a segment is integrated: the choices that `Settings(quadrature=...)` takes."""

import abc
from typing import Any, ClassVar

from jvr.model.parameters import assign, choice
from jvr.model.parts import AbstractPart, PlanEntry
from jvr.model.ranges import AT_LEAST_ONE
from jvr.model.transfer import AbstractTransfer, LinearTransfer, LutTransfer


class AbstractQuadrature(AbstractPart):
    """A rule for one segment. Static, without arrays."""

    # Whether the transfer function is integrated over the scalars between the ends of a segment.
    pre_integrates: ClassVar[bool] = False

    @property
    @abc.abstractmethod
    def explanation(self) -> str:
        """What the rule does, for `jvr.plan`."""

    @abc.abstractmethod
    def integrates(self, transfer: AbstractTransfer) -> bool:
        """Whether it can be used with a transfer function."""

    def explain(self, name: str, scene: Any, settings: Any) -> tuple[PlanEntry, ...]:
        return (PlanEntry("pre-integration", self.pre_integrates, self.explanation),)


class Midpoint(AbstractQuadrature):
    """The midpoint rule, the scalar at the middle of a segment for all of it: order 2 in the step where the transfer function is smooth,
    one resampling a segment. Peaks of the transfer function that the scalar passes between two samples are missed. The default."""

    @property
    def explanation(self) -> str:
        return "a segment has the colour and extinction of its midpoint"

    def integrates(self, transfer: AbstractTransfer) -> bool:
        return True


class PreIntegrated(AbstractQuadrature):
    """Pre-integration: the scalar goes linearly from the front of a segment to its back, and extinction and emission are integrated over
    all values between (`jvr.model.preintegration`): thin peaks are seen, at two resamplings a segment.

    **Arguments:** `parts`: how many parts of a segment its self-attenuation takes apart, order 4. Needs a `LinearTransfer` or a
    `LutTransfer`. **Raises** `ValueError` where `parts` is not a positive integer.
    """

    pre_integrates: ClassVar[bool] = True

    parts: int = choice(AT_LEAST_ONE, doc="parts of a segment that attenuate each other")

    def __init__(self, parts: int = 1):
        assign(self, parts=parts)

    @property
    def explanation(self) -> str:
        return f"segments are integrated between the scalars at their ends, self-attenuation in {self.parts} parts"

    def integrates(self, transfer: AbstractTransfer) -> bool:
        return isinstance(transfer, LinearTransfer | LutTransfer)
