"""The scene: a volume and everything that says how it looks."""

import equinox as eqx

from jvr.model.checks import float_array
from jvr.model.optical import AbstractOpticalModel, EmissionAbsorption
from jvr.model.transfer import AbstractTransfer
from jvr.model.volume import ClippingBox, Volume
from jvr.types import ArrayLike, Vector


class Scene(eqx.Module):
    """What is rendered. A part that is `None` leaves no trace in the compiled program.

    **Arguments:**

    - `volume`: `jvr.Volume`.
    - `transfer`: a transfer function, `jvr.LinearTransfer`, `jvr.LutTransfer` or `jvr.GaussianTransfer`.
    - `background`: `(3,)` linear RGB that shows through what is transparent, or `None`.
    - `optical`: `jvr.EmissionAbsorption()` (default), `jvr.EmissionOnly()` or `jvr.AbsorptionOnly()`.
    - `clipping`: `jvr.ClippingBox` or `None`.
    """

    volume: Volume
    transfer: AbstractTransfer
    background: Vector | None
    optical: AbstractOpticalModel
    clipping: ClippingBox | None

    def __init__(
        self,
        volume: Volume,
        transfer: AbstractTransfer,
        *,
        background: ArrayLike | None = None,
        optical: AbstractOpticalModel = EmissionAbsorption(),
        clipping: ClippingBox | None = None,
    ):
        self.volume = volume
        self.transfer = transfer
        self.background = None if background is None else float_array(background, "background", (3,))
        self.optical = optical
        self.clipping = clipping
