"""A differentiable direct volume renderer in JAX."""

import importlib
from typing import TYPE_CHECKING, Any

from jvr.names import NAMES

if TYPE_CHECKING:
    from jvr.effects.anisotropic import AnisotropicGGX as AnisotropicGGX
    from jvr.effects.deep_shadow_map import DeepShadowMap as DeepShadowMap
    from jvr.effects.histogram_occlusion import HistogramOcclusion as HistogramOcclusion
    from jvr.effects.in_scattering import InScattering as InScattering
    from jvr.effects.isosurfaces import Isosurfaces as Isosurfaces
    from jvr.effects.local_histograms import LocalHistograms as LocalHistograms
    from jvr.effects.occlusion import LocalOcclusion as LocalOcclusion
    from jvr.effects.phenomenological import PhenomenologicalBSDF as PhenomenologicalBSDF
    from jvr.effects.piecewise_shadows import PiecewiseShadows as PiecewiseShadows
    from jvr.effects.radiance_transfer import MaterialBleeding as MaterialBleeding
    from jvr.effects.radiance_transfer import RadianceTransfer as RadianceTransfer
    from jvr.effects.radiance_transfer import TransferBleeding as TransferBleeding
    from jvr.effects.scattering import SingleScattering as SingleScattering
    from jvr.effects.shading import BlinnPhong as BlinnPhong
    from jvr.effects.shading import Lambert as Lambert
    from jvr.effects.shading import Phong as Phong
    from jvr.effects.shadow_map import ShadowMap as ShadowMap
    from jvr.effects.shadow_rays import ShadowRays as ShadowRays
    from jvr.effects.shadow_volume import OpacityShadowMap as OpacityShadowMap
    from jvr.effects.shadow_volume import ShadowVolume as ShadowVolume
    from jvr.effects.specular import Specular as Specular
    from jvr.effects.surface_occlusion import SurfaceOcclusion as SurfaceOcclusion
    from jvr.execution.devices import use_all_cores as use_all_cores
    from jvr.fitting.bijectors import Bounded as Bounded
    from jvr.fitting.bijectors import Identity as Identity
    from jvr.fitting.bijectors import Ordered as Ordered
    from jvr.fitting.bijectors import Sigmoid as Sigmoid
    from jvr.fitting.bijectors import Softplus as Softplus
    from jvr.fitting.fit import fit as fit
    from jvr.fitting.grids import fit_on_grids as fit_on_grids
    from jvr.fitting.initialise import colours_given_extinction as colours_given_extinction
    from jvr.fitting.initialise import flat_transfer as flat_transfer
    from jvr.fitting.least_squares import Dogleg as Dogleg
    from jvr.fitting.least_squares import GaussNewton as GaussNewton
    from jvr.fitting.least_squares import LevenbergMarquardt as LevenbergMarquardt
    from jvr.fitting.losses import DSSIM as DSSIM
    from jvr.fitting.losses import AbsoluteError as AbsoluteError
    from jvr.fitting.losses import ColourSmoothness as ColourSmoothness
    from jvr.fitting.losses import ExtinctionSmoothness as ExtinctionSmoothness
    from jvr.fitting.losses import Huber as Huber
    from jvr.fitting.losses import Sparsity as Sparsity
    from jvr.fitting.losses import SquaredError as SquaredError
    from jvr.fitting.minimisers import LBFGSB as LBFGSB
    from jvr.fitting.next_view import Candidate as Candidate
    from jvr.fitting.next_view import next_view as next_view
    from jvr.fitting.residuals import residuals as residuals
    from jvr.fitting.result import FitResult as FitResult
    from jvr.fitting.unknowns import shared as shared
    from jvr.fitting.voxel_errors import VoxelErrors as VoxelErrors
    from jvr.fitting.voxel_errors import voxel_errors as voxel_errors
    from jvr.fitting.voxel_priors import Tikhonov as Tikhonov
    from jvr.fitting.voxel_priors import TotalVariation as TotalVariation
    from jvr.integrators.refinement import Refinement as Refinement
    from jvr.integrators.slices.oracle import BrickRange as BrickRange
    from jvr.integrators.slices.oracle import Finest as Finest
    from jvr.integrators.slices.oracle import GivenDistances as GivenDistances
    from jvr.integrators.slices.oracle import LocalError as LocalError
    from jvr.integrators.slices.oracle import OpacityChange as OpacityChange
    from jvr.integrators.slices.oracle import PixelSize as PixelSize
    from jvr.integrators.slices.picture import Slices as Slices
    from jvr.io.exported import use_export as use_export
    from jvr.io.images import read_image as read_image
    from jvr.io.kinds import register as register
    from jvr.io.precompute import precompute as precompute
    from jvr.io.scenes import load_scene as load_scene
    from jvr.io.scenes import save_scene as save_scene
    from jvr.io.volumes import read_volume as read_volume
    from jvr.march.differentiation import Forward as Forward
    from jvr.march.differentiation import Replay as Replay
    from jvr.march.differentiation import Rows as Rows
    from jvr.march.quadrature import Midpoint as Midpoint
    from jvr.march.quadrature import PreIntegrated as PreIntegrated
    from jvr.model import harmonics as harmonics
    from jvr.model import presets as presets
    from jvr.model.brdf import BlinnPhongBRDF as BlinnPhongBRDF
    from jvr.model.brdf import LambertBRDF as LambertBRDF
    from jvr.model.brdf import PhaseBRDF as PhaseBRDF
    from jvr.model.brdf import PhongBRDF as PhongBRDF
    from jvr.model.by_value import ByGradient as ByGradient
    from jvr.model.by_value import ByValue as ByValue
    from jvr.model.camera import OrthographicCamera as OrthographicCamera
    from jvr.model.camera import PerspectiveCamera as PerspectiveCamera
    from jvr.model.camera import PinholeCamera as PinholeCamera
    from jvr.model.camera import fibonacci_sphere as fibonacci_sphere
    from jvr.model.camera import orbit as orbit
    from jvr.model.clipping import ClippingBox as ClippingBox
    from jvr.model.clipping import ClippingPlane as ClippingPlane
    from jvr.model.dipole import Dipole as Dipole
    from jvr.model.environment import EnvironmentLight as EnvironmentLight
    from jvr.model.environment_map import EnvironmentMap as EnvironmentMap
    from jvr.model.geometry import DepthImage as DepthImage
    from jvr.model.gradient_transfer import GradientOpacity as GradientOpacity
    from jvr.model.gradient_transfer import GradientTransfer as GradientTransfer
    from jvr.model.interpolation import Nearest as Nearest
    from jvr.model.interpolation import Tricubic as Tricubic
    from jvr.model.interpolation import Trilinear as Trilinear
    from jvr.model.light import AmbientLight as AmbientLight
    from jvr.model.light import DirectionalLight as DirectionalLight
    from jvr.model.light import HeadLight as HeadLight
    from jvr.model.light import PointLight as PointLight
    from jvr.model.light import SpotLight as SpotLight
    from jvr.model.light import disc_light as disc_light
    from jvr.model.light import sphere_light as sphere_light
    from jvr.model.material import HarmonicMaterial as HarmonicMaterial
    from jvr.model.material import MaterialByValue as MaterialByValue
    from jvr.model.merl import MerlBRDF as MerlBRDF
    from jvr.model.mesh import Mesh as Mesh
    from jvr.model.microfacet import MicrofacetBRDF as MicrofacetBRDF
    from jvr.model.mie import Draine as Draine
    from jvr.model.mie import JendersieEon as JendersieEon
    from jvr.model.mie import TabulatedPhase as TabulatedPhase
    from jvr.model.normals import AnalyticGradient as AnalyticGradient
    from jvr.model.normals import CentralDifferences as CentralDifferences
    from jvr.model.normals import ForwardDifferences as ForwardDifferences
    from jvr.model.normals import PrecomputedGradient as PrecomputedGradient
    from jvr.model.normals import SobelDifferences as SobelDifferences
    from jvr.model.optical import AbsorptionOnly as AbsorptionOnly
    from jvr.model.optical import EmissionAbsorption as EmissionAbsorption
    from jvr.model.optical import EmissionOnly as EmissionOnly
    from jvr.model.phase import DoubleHenyeyGreenstein as DoubleHenyeyGreenstein
    from jvr.model.phase import HenyeyGreenstein as HenyeyGreenstein
    from jvr.model.phase import Isotropic as Isotropic
    from jvr.model.phase import Mixture as Mixture
    from jvr.model.phase import Rayleigh as Rayleigh
    from jvr.model.phase import Schlick as Schlick
    from jvr.model.scene import Scene as Scene
    from jvr.model.transfer import ClearTransfer as ClearTransfer
    from jvr.model.transfer import GaussianTransfer as GaussianTransfer
    from jvr.model.transfer import LinearTransfer as LinearTransfer
    from jvr.model.transfer import LutTransfer as LutTransfer
    from jvr.model.volume import Volume as Volume
    from jvr.pictures import linear_from_srgb as linear_from_srgb
    from jvr.pictures import srgb_from_linear as srgb_from_linear
    from jvr.pictures import write_image as write_image
    from jvr.rendering.advise import Advice as Advice
    from jvr.rendering.advise import advise as advise
    from jvr.rendering.image import Rendering as Rendering
    from jvr.rendering.image import RenderStats as RenderStats
    from jvr.rendering.layers import render_layers as render_layers
    from jvr.rendering.marching import Uniform as Uniform
    from jvr.rendering.measure import Measurement as Measurement
    from jvr.rendering.measure import measure as measure
    from jvr.rendering.pixel_filters import BoxFilter as BoxFilter
    from jvr.rendering.pixel_filters import GaussianFilter as GaussianFilter
    from jvr.rendering.pixel_filters import MitchellFilter as MitchellFilter
    from jvr.rendering.pixel_filters import TentFilter as TentFilter
    from jvr.rendering.plan import plan as plan
    from jvr.rendering.render import render as render
    from jvr.rendering.settings import Settings as Settings
    from jvr.rendering.tune import Tuned as Tuned
    from jvr.rendering.tune import tune as tune
    from jvr.types import Outcome as Outcome

    sh = harmonics

__version__ = "0.1.0"

# Everything is imported by its first use: JAX alone takes a second, fitting another, and a scene needs few of the effects. So the command
# line answers a wrong flag at once, and no moment of its start is outside of what catches Ctrl-C.
_MODULES = {"harmonics": "jvr.model.harmonics", "presets": "jvr.model.presets", "sh": "jvr.model.harmonics"}
_MODULE_OF = {name: module for module, names in NAMES.items() for name in names}


def __getattr__(name: str) -> Any:
    if name == "__all__":
        found = [*_MODULES, *_MODULE_OF]
    elif name in _MODULES:
        found = importlib.import_module(_MODULES[name])
    elif name in _MODULE_OF:
        found = getattr(importlib.import_module(_MODULE_OF[name]), name)
    else:
        raise AttributeError(f"module 'jvr' has no attribute {name!r}")
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *_MODULES, *_MODULE_OF})
