"""What of a scene is in the compiled program, decided from its structure alone."""

from jvr.march.march import AbstractShader
from jvr.march.steps import Point
from jvr.model.optical import AbstractOpticalModel
from jvr.model.transfer import Classified
from jvr.types import Channels, Scalar


class OpticalShader(AbstractShader):
    """The optical model alone: an unlit medium."""

    optical: AbstractOpticalModel

    def segment(self, medium: Classified, point: Point, dt: Scalar) -> tuple[Channels, Channels]:
        return self.optical.segment(medium, dt)
