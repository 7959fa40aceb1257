"""Hard cases of surfaces, occlusion, glow and surroundings: a ramp of six voxels, seen from above, with a surface where one is hard to
find, and random voxels that occlude, glow or stand before an environment."""

import dataclasses
from typing import Any

import numpy as np

import jvr
from experiments.stability_lit import SHAPE, Case, base

EYE, MIDDLE = np.array([7.0, -5.0, 15.0]), np.array([2.0, 2.5, 3.0])
TOP = SHAPE[2] - 1
HEIGHT = 3.1


def at_heights(
    *heights: float,
    opacity: Any = None,
    specular: Any = None,
    sigma: float = 1.0,
    camera: tuple[Any, Any] = (EYE, MIDDLE),
    label: str = "",
) -> Case:
    """Surfaces at heights (in voxels) of a volume whose scalar rises from 0 at its floor to 1 at its top."""
    case = base(values=np.indices(SHAPE)[2] / TOP, world=np.eye(4), sigma=sigma, shadows=None, camera=camera, label=label)
    colours = np.random.default_rng(2).random((len(heights), 3))
    surfaces = jvr.Isosurfaces(np.array(heights) / TOP, colours, opacity, most=3)
    return case._replace(scene=dataclasses.replace(case.scene, scattering=None, surfaces=surfaces, specular=specular))


def grazing(angle: float) -> tuple[Any, Any]:
    """A camera whose middle row of pixels meets the surface under an angle. It looks along the horizontal part of what is up for it, so
    that its rows are level."""
    target = np.array([MIDDLE[0], MIDDLE[1], HEIGHT])
    return target + 20.0 * np.array([-0.1 / 0.05**0.5, -0.2 / 0.05**0.5, angle]), target


def occluded(radius: float, values: np.ndarray | None = None, label: str = "") -> Case:
    """Ambient occlusion and a light that nothing shades."""
    lights = (jvr.AmbientLight((0.9, 0.6, 0.3)), jvr.DirectionalLight([0.5, 0.4, -0.6], [0.6, 0.8, 0.5]))
    case = base(values=values, world=np.eye(4), lights=lights, shadows=None, label=label)
    occlusion = jvr.LocalOcclusion(12, radius=radius, offset=min(0.5, radius / 2), samples=3, resolution=1.0)
    return case._replace(scene=dataclasses.replace(case.scene, scattering=None, occlusion=occlusion))


def glowing(emission: float, sigma: float) -> Case:
    """A medium that emits light of its own."""
    case = base(world=np.eye(4), shadows=None, lights=(), sigma=sigma, label=f"{emission:g}, extinction {sigma:g}")
    own = emission * np.random.default_rng(3).random((4, 3))
    transfer = dataclasses.replace(case.scene.transfer, emission=own)
    return case._replace(scene=dataclasses.replace(case.scene, transfer=transfer, shading=None, scattering=None))


def under_a_lamp(factor: float) -> Case:
    """A sky in pixels behind the volume that lights it, too; one pixel is so many times as bright as the others."""
    case = base(world=np.eye(4), shadows=None, lights=(), label=f"{factor:g}")
    pixels = 0.5 + np.random.default_rng(4).random((4, 8, 3))
    pixels[1, 5] *= factor
    sky = jvr.EnvironmentMap(pixels)
    parts = {"background": sky, "environment": sky, "material": jvr.LambertBRDF()}
    return case._replace(scene=dataclasses.replace(case.scene, shading=None, scattering=None, **parts))


def fibrous(along: float, across: float, direction: Any) -> Case:
    """A volume whose scalar rises along z, under lights of which one is mirrored to the eye."""
    to_eye = (EYE - MIDDLE) / np.linalg.norm(EYE - MIDDLE)
    lights = (jvr.DirectionalLight(to_eye * [1, 1, -1]), jvr.DirectionalLight([0.5, 0.4, -0.6], [0.6, 0.8, 0.5]))
    case = base(values=np.indices(SHAPE)[2] / TOP, world=np.eye(4), shadows=None, lights=lights, camera=(EYE, MIDDLE))
    # By the gradient, all of one length here.
    specular = jvr.ByGradient([0.1, 0.2], [0.2, 0.5])
    shading = jvr.AnisotropicGGX(direction, 0.1, 0.5, specular, along, across)
    scene = dataclasses.replace(case.scene, scattering=None, shading=shading)
    return case._replace(scene=scene, label=f"{along:g}, {across:g}, {direction}")


def surface_rows(quick: bool) -> dict[str, list[Case]]:
    """Hard cases of surfaces and of what is around them."""
    pick = lambda values: values[:: max(1, len(values) - 1)] if quick else values
    alone = np.full(SHAPE, 0.05)
    alone[2, 3, 3] = 0.85
    return {
        "surface tangent to rays, 0.1 ... 1e-5": [
            at_heights(HEIGHT, camera=grazing(angle), sigma=0.0, label=f"{angle:g}") for angle in pick([0.1, 1e-2, 1e-3, 1e-5])
        ],
        "surface in the last half voxel, and at the border": [
            at_heights(height, label=f"{height:g}") for height in pick([1e-3, 0.3, 5.7, TOP - 1e-3])
        ],
        "surface inside of a medium, depth 0 ... 1e8": [
            at_heights(HEIGHT, sigma=sigma, label=f"{sigma:g}") for sigma in pick([0.0, 1.0, 1e4, 1e8])
        ],
        "camera inside of a surface": [
            at_heights(HEIGHT, camera=(np.array([2.2, 2.6, below]), np.array([2.4, 2.3, 6.0])), label=f"{below:g}")
            for below in pick([0.7, 3.09])
        ],
        "surfaces 1e-4 voxels apart, opacity 0 and 1": [
            at_heights(HEIGHT, HEIGHT + apart, opacity=opacity, label=f"{apart:g}, {opacity}")
            for apart in pick([1e-4, 2.0])
            for opacity in pick([(0.3, 0.6), (1.0, 0.0), (0.0, 1.0), (0.0, 0.0)])
        ],
        "refractive index 1 ... 1.5, straight and grazing": [
            at_heights(
                HEIGHT,
                opacity=(0.2,),
                specular=jvr.Specular(index=index, order=1),
                camera=camera,
                label=f"{index:g}, {name}",
            )
            for index in pick([1.0, 1.000001, 1.5, 1 / 1.5])
            for name, camera in {"straight": (EYE, MIDDLE), "grazing": grazing(1e-3)}.items()
        ],
        "occlusion, radius 0 ... 1e3, of one voxel": [
            *(occluded(radius, label=f"{radius:g}") for radius in pick([0.0, 1.0, 1e3])),
            occluded(2.0, alone, "one voxel"),
        ],
        "emission 1e-8 ... 1e8, without extinction and with": [
            glowing(emission, sigma) for emission in pick([1e-8, 1.0, 1e8]) for sigma in (0.0, 1.0)
        ],
        "fibres along and ending on surfaces, roughness 0.05 ... 1": [
            fibrous(along, across, direction)
            for along, across in pick([(0.05, 0.05), (0.05, 1.0), (1.0, 0.05), (0.5, 0.5), (1.0, 1.0)])
            for direction in ((0.0, 0.0, 1.0), (1.0, 1e-6, 0.0), (0.6, 0.0, 0.8))
        ],
        "sky with a lamp 1e4 times as bright": [under_a_lamp(factor) for factor in pick([1.0, 1e4])],
    }
