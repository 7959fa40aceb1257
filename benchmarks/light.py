"""What light costs: shading, shadows and their gradients against the same picture without."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jvr
from benchmarks.peers import ours, scenes
from benchmarks.timing import median, ratio, seconds

SIZE = 256
NORMALS = {
    "analytic": jvr.AnalyticGradient(),
    "forward": jvr.ForwardDifferences(),
    "central": jvr.CentralDifferences(),
    "sobel": jvr.SobelDifferences(),
    "precomputed": jvr.PrecomputedGradient(),
}


def shadow_methods() -> dict[str, Any]:
    """Every way to shade a light, at its defaults."""
    return {
        "rays": jvr.ShadowRays(),
        "volume": jvr.ShadowVolume(),
        "opacity map": jvr.OpacityShadowMap(),
        "deep map": jvr.DeepShadowMap(),
        "map": jvr.ShadowMap(),
    }


def lit(scene: jvr.Scene, camera: jvr.PerspectiveCamera) -> jvr.Scene:
    """Blinn-Phong under a directional light from above the camera's shoulder and a little ambient light."""
    view = np.asarray(scene.volume.center) - np.asarray(camera.world_from_camera[:3, 3])
    across = np.cross(view, [0.0, 0.0, 1.0])
    direction = view / np.linalg.norm(view) + 0.8 * across / np.linalg.norm(across) - [0.0, 0.0, 0.8]
    lights = (jvr.DirectionalLight(direction, 1.0), jvr.AmbientLight(0.3))
    shading = jvr.BlinnPhong(ambient=0.8, diffuse=0.8, specular=0.3, shininess=40.0)
    return eqx.tree_at(
        lambda s: (s.lights, s.shading), scene, (lights, shading), is_leaf=lambda x: x is None or (isinstance(x, tuple) and not x)
    )


def light() -> dict[str, Any]:
    """Times as ratios, errors against exact shadow rays (RMSE over the largest value): bone and skin, 128^3 or a CT, at 256^2."""
    result: dict[str, Any] = {}
    for one in (scene for scene in scenes.four(128, SIZE) if scene.name in ("bone", "skin")):
        scene, camera = ours.to_jvr(one)
        _, quarter = ours.to_jvr(one.sized(SIZE // 4, SIZE // 4))
        result[f"{one.name} ({one.data})"] = _measured(scene, camera, quarter)
        jax.clear_caches()
    return result


def _measured(scene: jvr.Scene, camera: jvr.PerspectiveCamera, small: jvr.PerspectiveCamera) -> dict[str, Any]:
    """Shadow rays are timed, and errors taken, in the small picture: they take some hundred times as long as the rest."""
    shaded = lit(scene, camera)
    graded = eqx.tree_at(lambda s: s.volume, shaded, shaded.volume.graded())
    pictures = {"plain": scene}
    for name, kind in NORMALS.items():
        pictures[name] = dataclasses.replace(graded if name == "precomputed" else shaded, normals=kind)
    methods = {name: dataclasses.replace(shaded, shadows=method) for name, method in shadow_methods().items()}
    quick = pictures | {name: s for name, s in methods.items() if name != "rays"}
    times = seconds({name: lambda s=s: jvr.render(s, camera).rgb for name, s in quick.items()}, repeats=5)
    result: dict[str, Any] = {"plain_seconds": median(times, "plain"), "lit_seconds": median(times, "analytic")}
    result |= {f"shading_added_{name}": ratio(times, name, "plain") - 1 for name in NORMALS}
    result |= {f"shadow_added_{name}": ratio(times, name, "analytic") - 1 for name in methods if name != "rays"}
    slow = seconds(
        {name: lambda s=s: jvr.render(s, small).rgb for name, s in (("rays", methods["rays"]), ("lit", shaded))}, repeats=1
    )
    result["shadow_added_rays"] = ratio(slow, "rays", "lit") - 1
    exact = np.asarray(jvr.render(methods["rays"], small).rgb)
    for name, one in methods.items():
        error = np.asarray(jvr.render(one, small).rgb) - exact
        result[f"shadow_error_{name}"] = float(np.sqrt(np.mean(np.square(error))) / exact.max())
    return result | _gradients(methods["volume"], camera)


def _gradients(scene: jvr.Scene, camera: jvr.PerspectiveCamera) -> dict[str, Any]:
    """Image and gradient in the entries of the transfer function over the image, both in one program that skips nothing."""
    settings = jvr.Settings(0.5, skipping=False)
    into = lambda s: (s.transfer.rgb, s.transfer.sigma_t, s.lights[0].direction)
    loss = lambda u: jnp.mean(jnp.square(jvr.render(eqx.tree_at(into, scene, u), camera, settings).rgb - 0.5))
    image, gradient = jax.jit(lambda s: jvr.render(s, camera, settings).rgb), jax.jit(jax.value_and_grad(loss))
    times = seconds({"image": lambda: image(scene), "gradient": lambda: gradient(into(scene))}, repeats=3)
    return {"gradient_over_image_shadow_volume": ratio(times, "gradient", "image")}
