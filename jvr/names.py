"""The public names of `jvr`, by the module that each comes from. Also the only names that a file may call a class by."""

import importlib
import warnings
from collections.abc import Callable
from typing import Any


class Renamed:
    """What an attribute of a class was called before, for one release: it warns, and is what the attribute is under its new name."""

    def __init__(self, name: str):
        self.name = name

    def __set_name__(self, owner: type, name: str) -> None:
        self.before = name

    def __get__(self, instance: Any, owner: type) -> Any:
        warnings.warn(
            f"{owner.__name__}.{self.before} is called {self.name}; the next release knows that name alone",
            DeprecationWarning,
            stacklevel=2,
        )
        return getattr(owner if instance is None else instance, self.name)


NAMES = {
    "jvr.effects.anisotropic": ("AnisotropicGGX",),
    "jvr.effects.deep_shadow_map": ("DeepShadowMap",),
    "jvr.effects.histogram_occlusion": ("HistogramOcclusion",),
    "jvr.effects.in_scattering": ("InScattering",),
    "jvr.effects.local_histograms": ("LocalHistograms",),
    "jvr.effects.occlusion": ("LocalOcclusion",),
    "jvr.effects.isosurfaces": ("Isosurfaces",),
    "jvr.effects.phenomenological": ("PhenomenologicalBSDF",),
    "jvr.effects.piecewise_shadows": ("PiecewiseShadows",),
    "jvr.effects.radiance_transfer": ("MaterialBleeding", "RadianceTransfer", "TransferBleeding"),
    "jvr.effects.scattering": ("SingleScattering",),
    "jvr.effects.specular": ("Specular",),
    "jvr.effects.shading": ("BlinnPhong", "Lambert", "Phong"),
    "jvr.effects.shadow_map": ("ShadowMap",),
    "jvr.effects.shadow_rays": ("ShadowRays",),
    "jvr.effects.surface_occlusion": ("SurfaceOcclusion",),
    "jvr.effects.shadow_volume": ("OpacityShadowMap", "ShadowVolume"),
    "jvr.execution.devices": ("use_all_cores",),
    "jvr.fitting.grids": ("fit_on_grids",),
    "jvr.fitting.fit": ("fit",),
    "jvr.fitting.initialise": ("colours_given_extinction", "flat_transfer"),
    "jvr.fitting.least_squares": ("Dogleg", "GaussNewton", "LevenbergMarquardt"),
    "jvr.fitting.losses": (
        "AbsoluteError",
        "ColourSmoothness",
        "DSSIM",
        "ExtinctionSmoothness",
        "Huber",
        "Sparsity",
        "SquaredError",
    ),
    "jvr.fitting.minimisers": ("LBFGSB",),
    "jvr.fitting.next_view": ("Candidate", "next_view"),
    "jvr.fitting.residuals": ("residuals",),
    "jvr.fitting.voxel_errors": ("VoxelErrors", "voxel_errors"),
    "jvr.fitting.voxel_priors": ("Tikhonov", "TotalVariation"),
    "jvr.fitting.result": ("FitResult",),
    "jvr.fitting.unknowns": ("shared",),
    "jvr.fitting.bijectors": ("Bounded", "Identity", "Ordered", "Sigmoid", "Softplus"),
    "jvr.integrators.refinement": ("Refinement",),
    "jvr.integrators.slices.oracle": (
        "BrickRange",
        "Finest",
        "GivenDistances",
        "LocalError",
        "OpacityChange",
        "PixelSize",
    ),
    "jvr.integrators.slices.picture": ("Slices",),
    "jvr.io.exported": ("use_export",),
    "jvr.io.images": ("read_image",),
    "jvr.io.kinds": ("register",),
    "jvr.io.precompute": ("precompute",),
    "jvr.io.scenes": ("load_scene", "save_scene"),
    "jvr.io.volumes": ("read_volume",),
    "jvr.march.differentiation": ("Forward", "Replay", "Rows"),
    "jvr.march.quadrature": ("Midpoint", "PreIntegrated"),
    "jvr.model.brdf": ("BlinnPhongBRDF", "LambertBRDF", "PhaseBRDF", "PhongBRDF"),
    "jvr.model.by_value": ("ByGradient", "ByValue"),
    "jvr.model.camera": ("OrthographicCamera", "PerspectiveCamera", "PinholeCamera", "fibonacci_sphere", "orbit"),
    "jvr.model.clipping": ("ClippingBox", "ClippingPlane"),
    "jvr.model.dipole": ("Dipole",),
    "jvr.model.environment": ("EnvironmentLight",),
    "jvr.model.environment_map": ("EnvironmentMap",),
    "jvr.model.geometry": ("DepthImage",),
    "jvr.model.gradient_transfer": ("GradientOpacity", "GradientTransfer"),
    "jvr.model.interpolation": ("Nearest", "Tricubic", "Trilinear"),
    "jvr.model.light": ("AmbientLight", "DirectionalLight", "HeadLight", "PointLight", "SpotLight", "disc_light", "sphere_light"),
    "jvr.model.material": ("HarmonicMaterial", "MaterialByValue"),
    "jvr.model.merl": ("MerlBRDF",),
    "jvr.model.mesh": ("Mesh",),
    "jvr.model.microfacet": ("MicrofacetBRDF",),
    "jvr.model.mie": ("Draine", "JendersieEon", "TabulatedPhase"),
    "jvr.model.normals": (
        "AnalyticGradient",
        "CentralDifferences",
        "ForwardDifferences",
        "PrecomputedGradient",
        "SobelDifferences",
    ),
    "jvr.model.optical": ("AbsorptionOnly", "EmissionAbsorption", "EmissionOnly"),
    "jvr.model.phase": ("DoubleHenyeyGreenstein", "HenyeyGreenstein", "Isotropic", "Mixture", "Rayleigh", "Schlick"),
    "jvr.model.scene": ("Scene",),
    "jvr.model.transfer": ("ClearTransfer", "GaussianTransfer", "LinearTransfer", "LutTransfer"),
    "jvr.model.volume": ("Volume",),
    "jvr.pictures": ("linear_from_srgb", "srgb_from_linear", "write_image"),
    "jvr.rendering.advise": ("Advice", "advise"),
    "jvr.rendering.image": ("RenderStats", "Rendering"),
    "jvr.rendering.layers": ("render_layers",),
    "jvr.rendering.marching": ("Uniform",),
    "jvr.rendering.measure": ("Measurement", "measure"),
    "jvr.rendering.pixel_filters": ("BoxFilter", "GaussianFilter", "MitchellFilter", "TentFilter"),
    "jvr.rendering.plan": ("plan",),
    "jvr.rendering.render": ("render",),
    "jvr.rendering.settings": ("Settings",),
    "jvr.rendering.tune": ("Tuned", "tune"),
    "jvr.types": ("Outcome",),
}


def moved(module: str, names: dict[str, str]) -> Callable[[str], Any]:
    """The `__getattr__` of a module that had these names, which are elsewhere: for one release they are found there, with a warning."""

    def found(name: str) -> Any:
        if name not in names:
            raise AttributeError(f"module {module!r} has no attribute {name!r}")
        warnings.warn(f"{module}.{name} is {names[name]}", DeprecationWarning, stacklevel=2)
        home, _, new = names[name].rpartition(".")
        return getattr(importlib.import_module(home), new)

    return found
