"""A differentiable direct volume renderer in JAX."""

from jvr.march.differentiation import Forward as Forward
from jvr.march.differentiation import Replay as Replay
from jvr.march.differentiation import Rows as Rows
from jvr.model import presets as presets
from jvr.model.camera import OrthographicCamera as OrthographicCamera
from jvr.model.camera import PerspectiveCamera as PerspectiveCamera
from jvr.model.camera import fibonacci_sphere as fibonacci_sphere
from jvr.model.camera import orbit as orbit
from jvr.model.optical import AbsorptionOnly as AbsorptionOnly
from jvr.model.optical import EmissionAbsorption as EmissionAbsorption
from jvr.model.optical import EmissionOnly as EmissionOnly
from jvr.model.scene import Scene as Scene
from jvr.model.transfer import GaussianTransfer as GaussianTransfer
from jvr.model.transfer import LinearTransfer as LinearTransfer
from jvr.model.transfer import LutTransfer as LutTransfer
from jvr.model.volume import ClippingBox as ClippingBox
from jvr.model.volume import Nearest as Nearest
from jvr.model.volume import Trilinear as Trilinear
from jvr.model.volume import Volume as Volume
from jvr.rendering.image import Rendering as Rendering
from jvr.rendering.image import RenderStats as RenderStats
from jvr.rendering.image import render as render
from jvr.rendering.settings import Settings as Settings
from jvr.types import Outcome as Outcome
