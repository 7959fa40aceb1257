"""`jvr`, and in float64 the reference that every renderer is compared with."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jvr
from benchmarks.peers import scenes
from benchmarks.peers.errors import relative, rmse
from benchmarks.peers.settings import LIT_REFERENCE_STEP, REFERENCE_STEP, TERMINATION

ENTRIES = lambda scene: (scene.transfer.rgb, scene.transfer.sigma_t)


def version() -> str:
    return f"{jvr.__version__}, jax {jax.__version__}"


class Renderer:
    """One scene in `jvr`; voxels, transfer function and camera are arguments of the compiled programs."""

    def __init__(self, scene: scenes.Scene):
        self.scene, self.camera = scene_of(scene), camera_of(scene.view)

    def prepare(self, step: float, shadows: Any = None) -> None:
        """`shadows` is one of jvr's, for a scene that is lit."""
        if shadows is not None:
            self.scene = _shaded(self.scene, shadows)
        settings = jvr.Settings(step, termination=TERMINATION)
        self._image = lambda scene, camera: jvr.render(scene, camera, settings).rgb
        loss = lambda entries, scene, camera: _loss(entries, scene, camera, settings)
        self._gradient = jax.jit(jax.value_and_grad(loss, has_aux=True))

    def draw(self) -> None:
        self.drawn = np.asarray(self._image(self.scene, self.camera))

    def differentiate(self) -> None:
        """The picture, and the gradient of `mean((rgb - 0.5)^2)` in the entries of the transfer function."""
        (_, picture), slope = self._gradient(ENTRIES(self.scene), self.scene, self.camera)
        self.drawn, self.slope = np.asarray(picture), [np.asarray(x) for x in slope]

    def picture(self) -> np.ndarray:
        return self.drawn

    def error(self, reference: np.ndarray) -> float:
        return rmse(self.drawn, reference)

    def gradient_error(self, reference: tuple[np.ndarray, np.ndarray]) -> tuple[float, float]:
        """Relative errors in the colours and in the extinctions."""
        return relative(self.slope[0], reference[0]), relative(self.slope[1], reference[1])


class Packed(Renderer):
    """The same with 8-bit voxels, packed."""

    def __init__(self, scene: scenes.Scene):
        super().__init__(scene)
        volume = lambda s: s.volume
        self.scene = eqx.tree_at(volume, self.scene, self.scene.volume.packed().bricked(), is_leaf=lambda x: x is None)


class Reference:
    """The same scene in float64, with short steps, every ray to its end, nothing skipped; shadows by rays, with the same steps."""

    def __init__(self, scene: scenes.Scene):
        if jnp.zeros(()).dtype != jnp.float64:
            raise RuntimeError("the reference needs JAX_ENABLE_X64=1")
        self.scene, self.view = scene_of(scene), scene.view
        step = REFERENCE_STEP if scene.scattering is None else LIT_REFERENCE_STEP
        self.settings = jvr.Settings(step, termination=0.0, skipping=False)
        if scene.scattering is not None:
            self.scene = _shaded(self.scene, jvr.ShadowRays(step, termination=0.0))

    def picture(self, across: int = 1) -> np.ndarray:
        """One ray through the centre of each pixel, or the mean of `across` x `across` rays spread over it."""
        view = self.view
        fine = dataclasses.replace(view, width=across * view.width, height=across * view.height)
        seen = jax.jit(jvr.render)(self.scene, camera_of(fine), self.settings).rgb
        return np.asarray(seen).reshape(view.height, across, view.width, across, 3).mean(axis=(1, 3))

    def gradient(self) -> tuple[np.ndarray, np.ndarray]:
        gradient, _ = jax.jit(jax.grad(_loss, has_aux=True), static_argnums=3)(
            ENTRIES(self.scene), self.scene, camera_of(self.view), self.settings
        )
        return jax.tree.map(np.asarray, gradient)


def to_jvr(scene: scenes.Scene) -> tuple[jvr.Scene, jvr.PerspectiveCamera]:
    """A scene of the peers as jvr's own."""
    return scene_of(scene), camera_of(scene.view)


def _loss(entries: Any, scene: jvr.Scene, camera: jvr.PerspectiveCamera, settings: jvr.Settings) -> tuple[jax.Array, jax.Array]:
    picture = jvr.render(eqx.tree_at(ENTRIES, scene, entries), camera, settings).rgb
    return _difference(picture), picture


# Operation by operation it would take as long as a small picture.
_difference = jax.jit(lambda picture: jnp.mean(jnp.square(picture - 0.5)))


def scene_of(scene: scenes.Scene) -> jvr.Scene:
    world_from_grid = np.diag([*scene.spacing, 1.0])
    world_from_grid[:3, 3] = scene.origin
    # As the others, bounds its bricks once.
    volume = jvr.Volume(scene.voxels, world_from_grid).bricked()
    transfer = jvr.LutTransfer(scene.rgb, scene.sigma_t, scene.domain)
    if scene.absorption:
        return jvr.Scene(volume, transfer, background=(1, 1, 1), optical=jvr.AbsorptionOnly())
    if scene.scattering is not None:
        light = scene.scattering
        once = jvr.SingleScattering(jvr.HenyeyGreenstein(light.g), light.albedo)
        sun = jvr.DirectionalLight(light.direction, light.irradiance)
        return jvr.Scene(volume, transfer, background=(0, 0, 0), lights=(sun,), scattering=once)
    return jvr.Scene(volume, transfer, background=(0, 0, 0))


def _shaded(scene: jvr.Scene, shadows: Any) -> jvr.Scene:
    return eqx.tree_at(lambda s: s.shadows, scene, shadows, is_leaf=lambda x: x is None)


def camera_of(view: scenes.View) -> jvr.PerspectiveCamera:
    return jvr.PerspectiveCamera.look_at(view.eye, view.target, view.up, view.fov_y, view.width, view.height)
