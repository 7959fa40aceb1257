"""Shadows: every method against exact rays, what each promises, and derivatives through them against finite differences."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import OBLIQUE, affine, linear_transfer, perspective, render, voxels

import jvr

EXACT = jvr.ShadowRays(0.1, termination=0)
SETTINGS = jvr.Settings(0.5, termination=0)


def cloud(n=12):
    """Two smooth blobs in a haze, oblique and anisotropic."""
    x, y, z = np.meshgrid(*[np.linspace(-1, 1, n)] * 3, indexing="ij")
    blob = lambda a, b, c, sharpness: np.exp(-sharpness * ((x - a) ** 2 + (y - b) ** 2 + (z - c) ** 2))
    values = blob(0.3, 0, -0.2, 4) + 0.8 * blob(-0.4, 0.3, 0.3, 6) + 0.1
    return jvr.Volume(values, affine((1, 1.3, 0.8), (3, -2, 1), (0.3, 0.2, -0.5)))


def lights(volume):
    center, radius = np.asarray(volume.center), float(volume.radius)
    return {
        "directional": jvr.DirectionalLight([0.5, 0.4, -0.6], [1.0, 2.0, 0.5]),
        "outside": jvr.PointLight(center + np.array([0.8, 1.1, 0.4]) * radius, 4 * radius**2),
        "just outside": jvr.PointLight(center + 0.68 * radius, 20.0, radius=0.7),
        "inside": jvr.PointLight(center + np.array([0.3, -0.2, 0.35]), 20.0, radius=0.7),
        "in the middle": jvr.PointLight(center, 20.0, radius=0.7),
    }


LIGHTS = ("directional", "outside", "just outside", "inside", "in the middle")
COLOURED = jvr.LinearTransfer([0.0, 1.0], np.zeros((2, 3)), [[0, 0, 0], [0.3, 0.6, 0.15]])


def picture(some, shadows, volume=None, transfer=COLOURED, settings=SETTINGS, **options):
    volume = cloud() if volume is None else volume
    scene = jvr.Scene(volume, transfer, lights=some, shadows=shadows, scattering=jvr.SingleScattering(), **options)
    return render(scene, perspective(volume, 10, 8), settings)


@functools.cache
def exact_picture(name):
    return np.asarray(picture([lights(cloud())[name]], EXACT).rgb)


def error(name, shadows):
    """RMSE relative to the picture's own."""
    rgb, exact = np.asarray(picture([lights(cloud())[name]], shadows).rgb), exact_picture(name)
    return np.sqrt(np.mean((rgb - exact) ** 2) / np.mean(exact**2))


# Twice and four times as many nodes along each axis.
VOLUMES = tuple(jvr.ShadowVolume(r) for r in (2 / 3, 4 / 3, 8 / 3))
MAPS = tuple(jvr.OpacityShadowMap(n, n) for n in (16, 32, 64))
# A coarse and a fine choice of each method's knobs, and what is left of the error at most: they are of second order in nodes, or of first
# in the allowed error of each piece.
REFINED = {
    "rays": (jvr.ShadowRays(2.0), jvr.ShadowRays(0.5, termination=0), 0.2),
    "volume": (VOLUMES[0], VOLUMES[-1], 0.15),
    "opacity map": (MAPS[0], MAPS[-1], 0.15),
    "deep map": (jvr.DeepShadowMap(10, 6, error=0.04), jvr.DeepShadowMap(40, 20, error=0.0025), 0.2),
    "piecewise": (jvr.PiecewiseShadows(2, 1 / 4), jvr.PiecewiseShadows(2, 1.0), 0.25),
}


@pytest.mark.slow
@pytest.mark.parametrize("method", REFINED)
@pytest.mark.parametrize("name", LIGHTS)
def test_refined_shadows_converge_to_exact_rays(method, name, x64):
    coarse, fine, left = REFINED[method]
    # The shadow is there to be seen.
    assert error(name, None) > 0.1
    before, after = error(name, coarse), error(name, fine)
    assert after < left * before, (before, after)
    # What a picture of 8 bits can hold, and a little.
    assert after < 8e-3, after


@pytest.mark.slow
@pytest.mark.parametrize("name", LIGHTS)
def test_order_of_convergence(name, x64):
    for errors in ([error(name, s) for s in nodes] for nodes in (VOLUMES, MAPS)):
        order = -np.polyfit(np.log([1, 2, 4]), np.log(errors), 1)[0]
        # Nodes beside a border of the volume, where extinction ends at once, are of first order.
        assert order > 1.5, (errors, order)


@pytest.mark.slow
@pytest.mark.parametrize("shadows", [jvr.ShadowRays(), jvr.OpacityShadowMap(), jvr.DeepShadowMap()])
def test_defaults_are_within_a_hundredth(shadows, x64):
    for name in LIGHTS:
        assert error(name, shadows) < 0.01, name


@pytest.mark.slow
@pytest.mark.parametrize("shadows", [jvr.ShadowVolume(0.7), jvr.OpacityShadowMap(9, 5), jvr.DeepShadowMap(9, 40, error=1e-6)])
def test_homogeneous_medium(shadows, x64):
    """Whatever the number of nodes, optical depth is linear along a light's ray inside of a box whose sides the light shines along."""
    volume = jvr.Volume(np.ones((6, 5, 7)))
    sigma = 0.2
    transfer = jvr.LinearTransfer([0.0, 1.0], np.zeros((2, 3)), [sigma, sigma])
    light = jvr.DirectionalLight([0, 0, -1.0])
    camera = jvr.OrthographicCamera.look_at([2.5, -9, 3], [2.5, 2, 3], [0, 0, 1], 1.0, 3, 3)
    scene = lambda s: jvr.Scene(volume, transfer, lights=(light,), shadows=s, scattering=jvr.SingleScattering())
    found, exact = (np.asarray(render(scene(s), camera, SETTINGS).rgb) for s in (shadows, jvr.ShadowRays(9.0, termination=0)))
    # Only nodes beside the border, which the map does not know to be in the middle of a layer, differ.
    np.testing.assert_allclose(found, exact, atol=0.02 * exact.max())


def opaque_block(light, shadows, n=24):
    """A thin haze with an opaque block in it; light from above. Rows of the picture go down, seen from the side."""
    values = np.zeros((n, n, n))
    values[8:16, 8:16, 14:18] = 1
    volume = jvr.Volume(values)
    transfer = jvr.LinearTransfer([0.0, 0.4, 0.6, 1.0], np.zeros((4, 3)), [0.002, 0.002, 50.0, 50.0])
    camera = jvr.OrthographicCamera.look_at([11.5, 60.0, 11.5], [11.5, 11.5, 11.5], [0, 0, 1], 22.0, 22, 22)
    clipping = jvr.ClippingBox([-1, 10.0, -1], [n, 13.0, n])
    scene = jvr.Scene(volume, transfer, lights=(light,), shadows=shadows, scattering=jvr.SingleScattering(), clipping=clipping)
    return np.asarray(render(scene, camera, SETTINGS).rgb)[..., 0]


@pytest.mark.slow
@pytest.mark.parametrize(
    "light",
    [jvr.DirectionalLight([0.5, 0, -1]), jvr.PointLight([11.5, 11.5, 40.0], 800.0)],
    ids=["oblique", "point"],
)
def test_shadow_map_of_an_opaque_block(light):
    exact, found = (opaque_block(light, s) for s in (jvr.ShadowRays(0.5), jvr.ShadowMap(64, softness=0)))
    bright = np.median(exact)
    # The block itself and the depth `bias` around it are lit by the map and not by rays, which the block's own surface shades.
    x, z = np.meshgrid(np.arange(1, 23), 22 - np.arange(22))
    block = (x > 6) & (x < 18) & (z > 11) & (z < 21)
    exact, found = exact[~block], found[~block]
    assert 15 < (exact < 0.02 * bright).sum() < 250
    assert (exact > 0.9 * bright).sum() > 100
    # Apart from edges of the shadow, of a texel, nothing differs but by what the haze takes away.
    wrong = np.abs(found - exact) > 0.1 * bright
    assert wrong.mean() < 0.12


@pytest.mark.slow
def test_shadow_map_is_hard_where_exact_shadows_are_soft(x64):
    """It does not converge in translucent media, and says so."""
    assert error("inside", jvr.ShadowMap(24)) > 0.2
    assert "does not converge" in jvr.ShadowMap.__doc__


@pytest.mark.slow
def test_shadow_map_is_detached(x64):
    """The derivative in the light's irradiance is there; nothing comes through the map."""
    light, volume = lights(cloud())["directional"], cloud()
    camera = perspective(volume, 4, 3)

    def mean(direction, irradiance):
        scene = jvr.Scene(
            volume,
            COLOURED,
            lights=(jvr.DirectionalLight(direction, irradiance),),
            shadows=jvr.ShadowMap(16),
            scattering=jvr.SingleScattering(),
        )
        return jnp.mean(jvr.render(scene, camera, SETTINGS).rgb)

    of_direction, of_irradiance = jax.jit(jax.grad(mean, argnums=(0, 1)))(light.direction, light.irradiance)
    # Isotropic scattering: the direction matters for shadows alone.
    assert not of_direction.any()
    assert np.all(np.asarray(of_irradiance) > 0)


@pytest.mark.slow
def test_deep_map_keeps_its_error_and_reports_where_it_cannot(x64):
    light = lights(cloud())["directional"]
    texels = 16
    reports = {}
    for layers in (1, 30):
        stats = picture([light], jvr.DeepShadowMap(texels, layers, error=0.01)).stats.shadows
        reports[layers] = (float(stats.overflow), float(stats.error))
    assert reports[30][0] == 0
    assert 0.001 < reports[30][1] <= 0.01 * (1 + 1e-9)
    # One straight piece for a whole ray.
    assert reports[1][0] > 0.3
    assert 0.05 < reports[1][1] < 1
    # Other methods, and none, have nothing to report.
    assert picture([light], VOLUMES[0]).stats.shadows is None
    assert picture([light], None).stats.shadows is None


@pytest.mark.slow
@pytest.mark.parametrize("shadows", [jvr.ShadowRays(0.7), jvr.ShadowVolume(1.0)])
def test_skipping_changes_nothing(shadows):
    """Bricks that are empty are skipped by the eye's rays and by the light's."""
    values = voxels((17, 15, 16))
    values[:, 6:, :9] = 0
    volume = jvr.Volume(values, affine((1.0, 1.3, 0.9), angles=(0.3, 0.1, -0.4)))
    transfer = jvr.LinearTransfer([0.1, 0.2, 0.6], np.zeros((3, 3)), [[0, 0, 0], [0, 0, 0], [0.3, 0.1, 0.2]])
    for name in ("directional", "inside"):
        light = lights(volume)[name]
        on, off = (
            picture([light], shadows, volume, transfer, jvr.Settings(0.5, termination=0, skipping=skipping))
            for skipping in (True, False)
        )
        assert np.asarray(on.stats.steps).sum() < 0.85 * np.asarray(off.stats.steps).sum()
        np.testing.assert_allclose(on.rgb, off.rgb, rtol=2e-5, atol=2e-6 * np.asarray(off.rgb).max())


@pytest.mark.slow
def test_termination_of_shadow_rays_bounds_their_error():
    dense = jvr.LinearTransfer([0.0, 1.0], np.zeros((2, 3)), [[0, 0, 0], [4.0, 6.0, 3.0]])
    light = lights(cloud())["directional"]
    exact, ended = (np.asarray(picture([light], jvr.ShadowRays(0.7, termination=t), transfer=dense).rgb) for t in (0.0, 0.05))
    # Where a ray ends at the transmittance 0.05 none or all of that may have been left. Radiance per unit of light: E / (4 pi).
    most = 0.05 * np.asarray(light.irradiance) / (4 * np.pi)
    assert np.abs(ended - exact).max() > 0
    assert np.all(np.abs(ended - exact) <= most * (1 + 1e-4))


@pytest.mark.slow
def test_several_lights_each_cast_their_own_shadow(x64):
    casting, head = [lights(cloud())[name] for name in ("directional", "outside", "inside")], jvr.HeadLight(0.2)
    lit_by_head = np.asarray(picture([head], None).rgb)
    # Methods whose pictures by one light other tests have compiled.
    for shadows in (EXACT, MAPS[0]):
        together = picture([*casting, head], shadows).rgb
        apart = [np.asarray(picture([light], shadows).rgb) for light in casting]
        np.testing.assert_allclose(together, sum(apart) + lit_by_head, rtol=1e-10)


# Derivatives.

SHADOWS = {
    "none": None,
    "rays": jvr.ShadowRays(0.8, termination=0),
    "volume": jvr.ShadowVolume(1.0),
    "opacity map": jvr.OpacityShadowMap(7, 6),
    "deep map": jvr.DeepShadowMap(6, 4, error=0.02),
    "piecewise": jvr.PiecewiseShadows(0.8, 0.6),
}
# Sheared: where all corners are equally far from the middle, how far light is fanned out has a kink.
SHEARED = OBLIQUE @ np.array([[1, 0.1, -0.05, 0], [0, 1, 0.15, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])
DIFFERENCES, ROUNDING = 2e-6, 1e-11


def parameters():
    volume = jvr.Volume(voxels((3, 4, 5)), SHEARED)
    center, radius = np.asarray(volume.center), float(volume.radius)
    return {
        "transfer": linear_transfer(coloured=True),
        "voxels": volume.values,
        "world_from_grid": volume.world_from_grid,
        "sun": {"direction": jnp.array([0.5, 0.4, -0.6]), "irradiance": jnp.array([1.0, 2.0, 0.5])},
        "lamp": {"position": center + radius * jnp.array([0.8, 1.1, 0.4]), "intensity": jnp.array(2 * radius**2)},
        "torch": {
            "position": center + jnp.array([0.3, -0.2, 0.35]),
            "direction": jnp.array([1.0, 1, 0.5]),
            "intensity": jnp.array(2.0),
        },
        "eye": center + radius * jnp.array([1.8, -1.1, 0.9]),
        "g": jnp.array(0.3),
        "albedo": jnp.array([0.8, 0.6, 0.9]),
        "threshold": jnp.array(0.05),
    }


BUILT = {
    "sun": lambda p: jvr.DirectionalLight(**p["sun"]),
    "lamp": lambda p: jvr.PointLight(**p["lamp"]),
    "torch": lambda p: jvr.SpotLight(**p["torch"], inner=30.0, outer=120.0, radius=0.7),
}


def loss(p, shadows, adjoint, names):
    volume = jvr.Volume(p["voxels"], p["world_from_grid"])
    camera = jvr.PerspectiveCamera.look_at(p["eye"], np.asarray([0.0, 8.0, 14.0]), [0.1, 0.2, 1.0], 42.0, 5, 4)
    scene = jvr.Scene(
        volume,
        p["transfer"],
        lights=tuple(BUILT[name](p) for name in names),
        shading=jvr.Lambert(0.0, 0.4, threshold=p["threshold"]),
        shadows=shadows,
        scattering=jvr.SingleScattering(jvr.HenyeyGreenstein(p["g"]), p["albedo"]),
    )
    image = jvr.render(scene, camera, jvr.Settings(0.7, termination=0, adjoint=adjoint))
    wave = jnp.sin(jnp.arange(1.0, image.rgb.size + 1)).reshape(image.rgb.shape)
    return jnp.sum(wave * image.rgb) + jnp.mean(image.rgb)


def directions(p, seed=0):
    """For each array, and the sun's part and so on, a direction in it alone; the last row of an affine transform is none."""
    rng = np.random.default_rng(seed)
    leaves, structure = jax.tree.flatten(p)
    names = [jax.tree_util.keystr(path) for path, _ in jax.tree_util.tree_leaves_with_path(p)]
    moves = []
    for k, name in enumerate(names):
        move = [np.zeros(x.shape) for x in leaves]
        move[k] = rng.standard_normal(leaves[k].shape)
        if "world_from_grid" in name:
            move[k][3] = 0
        moves.append(jax.tree.unflatten(structure, move))
    return names, jax.tree.map(lambda *x: jnp.stack(x), *moves)


# Where light comes from is one piece of code for all methods: rays are traced to each kind of light, the others know one each.
CASES = {
    "none": ("lamp",),
    "rays, torch": ("torch",),
    "rays, sun and lamp": ("sun", "lamp"),
    "volume, lamp": ("lamp",),
    "opacity map, torch": ("torch",),
    "deep map, sun": ("sun",),
    "piecewise, torch": ("torch",),
}


def along_each(p, moves, value, h=1e-6):
    """Along each direction: the derivative in forward mode, and by central differences."""
    move = lambda t: jax.tree.map(lambda x, d: x + t * h * d, jax.tree.map(lambda x: x[None], p), moves)
    points = jax.tree.map(lambda *x: jnp.stack(x), *map(move, (-1.0, 0.0, 1.0)))
    both = lambda at: jax.lax.map(lambda x: jax.jvp(value, (x[0],), (x[1],)), (at, moves))
    values, slopes = map(np.asarray, jax.jit(lambda points: jax.lax.map(both, points))(points))
    return slopes[1], (values[2] - values[0]) / (2 * h)


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_derivatives_in_every_mode(case, x64):
    """Along a random direction in each kind of array (transfer function, voxels, lights, pose, camera, phase function, albedo): the
    gradient by replay, forward mode, forward mode through the rule of replay, and central differences."""
    names, shadows = CASES[case], SHADOWS[case.split(",")[0]]
    unused = set(BUILT) - set(names)
    p = {name: x for name, x in parameters().items() if name not in unused}
    value = lambda adjoint: lambda p: loss(p, shadows, adjoint, names)
    leaves, moves = directions(p)
    gradient = jax.jit(jax.grad(value(jvr.Replay())))(p)
    reverse = [
        sum(jnp.vdot(g, m[k]) for g, m in zip(*map(jax.tree.leaves, (gradient, moves)), strict=True)) for k in range(len(leaves))
    ]
    forward, differences = along_each(p, moves, value(jvr.Forward()))
    replayed = jax.jit(lambda moves: jax.lax.map(lambda d: jax.jvp(value(jvr.Replay()), (p,), (d,))[1], moves))(moves)
    # Each entry to rounding of the largest of its array, summed along the direction.
    sizes = [
        jnp.max(jnp.abs(g)) * jnp.sum(jnp.abs(m[k]))
        for k, (g, m) in enumerate(zip(*map(jax.tree.leaves, (gradient, moves)), strict=True))
    ]
    for name, size, a, b, c, d in zip(leaves, sizes, reverse, forward, replayed, differences, strict=True):
        assert abs(d) > 1e-5, name
        # Rounding of a loss near 1, divided by h, is 1e-9.
        assert abs(a - d) <= DIFFERENCES * abs(d) + 2e-9, (name, a, d)
        np.testing.assert_allclose([a, c], b, rtol=0, atol=ROUNDING * size, err_msg=name)


@pytest.mark.slow
def test_a_clipping_box_with_shadows(x64):
    """Its faces move where rays of the eye and of the light begin and end."""
    p = parameters()
    volume = jvr.Volume(p["voxels"], p["world_from_grid"])
    center = np.asarray(volume.center)
    camera = perspective(volume, 5, 4)

    def of_faces(shadows, adjoint, faces):
        scene = jvr.Scene(
            volume,
            p["transfer"],
            clipping=jvr.ClippingBox(*faces),
            lights=(jvr.DirectionalLight(**p["sun"]), jvr.PointLight(**p["lamp"])),
            shadows=shadows,
            scattering=jvr.SingleScattering(),
        )
        return jnp.mean(jvr.render(scene, camera, jvr.Settings(0.7, termination=0, adjoint=adjoint)).rgb)

    faces = jnp.stack([center - jnp.array([1.1, 1.9, 1.3]), center + jnp.array([1.2, 1.4, 2.1])])
    for name in ("rays", "opacity map"):
        mean = functools.partial(of_faces, SHADOWS[name])
        gradient = jax.jit(jax.grad(functools.partial(mean, jvr.Replay())))(faces)
        moved = faces + 1e-6 * np.concatenate([np.eye(6), -np.eye(6)]).reshape(12, 2, 3)
        above, below = np.split(
            np.asarray(jax.jit(functools.partial(jax.lax.map, functools.partial(mean, jvr.Forward())))(moved)), 2
        )
        expected = ((above - below) / 2e-6).reshape(2, 3)
        np.testing.assert_allclose(gradient, expected, atol=1e-6 * np.abs(expected).max())


@pytest.mark.slow
@pytest.mark.parametrize("shadows", [jvr.ShadowRays(0.5), jvr.ShadowVolume(1.0)])
def test_light_moved_and_occluder_thickened(shadows, x64):
    """An occluder between a lamp and a screen, which the camera sees from the side: how bright the screen is against finite
    differences of a size that one would see, in the extinction of the occluder and in the place of the lamp."""
    n = 13
    x, y, z = np.meshgrid(*[np.linspace(-6, 6, n)] * 3, indexing="ij")
    values = np.exp(-((x**2 + y**2 + (z - 2) ** 2) / 4)) + 2 * (z == -5)
    volume = jvr.Volume(values)
    camera = jvr.OrthographicCamera.look_at([6, 30, 1.0], [6, 6, 1.0], [0, 0, 1], 0.6, 40, 2)

    def brightness(p):
        # The screen, of scalar 2, scatters; the occluder is 0 ... 1 and black.
        transfer = jvr.LinearTransfer(
            [0.0, 1.0, 1.5, 2.0],
            np.zeros((4, 3)),
            jnp.array([0.0, 1.0, 0.0, 0.0]) * p["occluder"] + 0.3 * jnp.array([0.0, 0, 0, 1]),
        )
        scene = jvr.Scene(
            volume,
            transfer,
            lights=(jvr.PointLight(p["position"], 100.0),),
            shadows=shadows,
            scattering=jvr.SingleScattering(albedo=jvr.ByValue([1.4, 1.6], [0.0, 1.0])),
        )
        return jnp.mean(jvr.render(scene, camera, jvr.Settings(0.5)).rgb[:, 14:20])

    p = {"occluder": jnp.array(0.6), "position": jnp.array([7.0, 6.3, 16.0])}
    gradient = jax.jit(jax.grad(brightness))(p)
    moves = [("occluder", 0.01 * np.ones(()))] + [("position", 0.01 * np.eye(3)[a]) for a in range(3)]
    ends = [p | {name: p[name] + sign * move} for name, move in moves for sign in (1, -1)]
    values = jax.jit(lambda ends: jax.lax.map(brightness, ends))(jax.tree.map(lambda *x: jnp.stack(x), *ends)).reshape(-1, 2)
    for (name, move), (above, below) in zip(moves, np.asarray(values), strict=True):
        expected, found = above - below, 2 * np.sum(move * np.asarray(gradient[name]))
        # Central differences of steps of a hundredth: their own error is up to 4e-3 (one of 2e-4 a tenth as long), from the kinks between
        # the nodes of a shadow volume.
        np.testing.assert_allclose(found, expected, rtol=0.01, err_msg=name)
    assert gradient["occluder"] < 0


@pytest.mark.slow
def test_vmap_of_gradients_through_shadows(x64):
    """A batch of lights: each gradient is that of one light by itself."""
    p = parameters()
    shone = lambda direction: p | {"sun": p["sun"] | {"direction": direction}}
    of = jax.grad(lambda direction: loss(shone(direction), SHADOWS["rays"], jvr.Replay(), ("sun",)))
    several = jnp.stack([p["sun"]["direction"], jnp.array([-0.3, 1.0, 0.2])])
    np.testing.assert_allclose(jax.jit(jax.vmap(of))(several), jax.lax.map(of, several), rtol=1e-10)


@pytest.mark.parametrize(
    ("make", "error"),
    {
        "step": (lambda: jvr.ShadowRays(0.0), ValueError),
        "termination": (lambda: jvr.ShadowRays(termination=1.0), ValueError),
        "resolution": (lambda: jvr.ShadowVolume(0), ValueError),
        "resolution too high": (lambda: jvr.ShadowVolume(5.0), ValueError),
        "texels": (lambda: jvr.OpacityShadowMap(1), ValueError),
        "layers": (lambda: jvr.OpacityShadowMap(8, 0), ValueError),
        "deep layers": (lambda: jvr.DeepShadowMap(8, 0), ValueError),
        "deep error": (lambda: jvr.DeepShadowMap(error=0.0), ValueError),
        "deep error of 1": (lambda: jvr.DeepShadowMap(error=1.0), ValueError),
        "threshold": (lambda: jvr.ShadowMap(threshold=1.0), ValueError),
        "softness": (lambda: jvr.ShadowMap(softness=-1), ValueError),
        "bias": (lambda: jvr.ShadowMap(bias=-1.0), ValueError),
        "piece": (lambda: jvr.PiecewiseShadows(-1), ValueError),
        "nodes": (lambda: jvr.PiecewiseShadows(resolution=1.5), ValueError),
        "texels of a map": (lambda: jvr.ShadowMap(1), ValueError),
    }.values(),
    ids=lambda x: "",
)
def test_what_cannot_be_right_is_refused(make, error):
    with pytest.raises(error):
        make()
