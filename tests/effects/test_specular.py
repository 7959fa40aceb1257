"""Mirrors and glass: pictures against what is known of planes, slabs and balls, derivatives against differences, files and refusals."""

import collections
import dataclasses
import re
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import render

import jvr
from jvr.io.config import ConfigError, build_scene, config_from

CLEAR = jvr.LinearTransfer([-40.0, 40.0], np.zeros((2, 3)), np.zeros(2))
SETTINGS = jvr.Settings(0.5, termination=0)


def sky():
    """In the precision of the moment."""
    return jvr.EnvironmentMap(0.2 + np.random.default_rng(1).random((4, 8, 3)))


def ramp(shape=(8, 8, 9)):
    """The scalar is the third coordinate, from 0 to 8."""
    return np.indices(shape).astype(float)[2]


def tilted(volume, degrees, size=4, extent=1.0, eye=None):
    """Parallel rays down the third axis, at an angle from it towards the first."""
    a = np.radians(degrees)
    center = np.asarray(volume.center if eye is None else eye, float)
    away = np.array([np.sin(a), 0, np.cos(a)])
    back = center + (20 * away if eye is None else 0)
    return jvr.OrthographicCamera.look_at(back, back - away, [0, 1, 0], extent, size, size)


def planes(levels, rgb, opacity=None, **parts):
    volume = parts.pop("volume", jvr.Volume(ramp()))
    surfaces = jvr.Isosurfaces(levels, rgb, opacity, most=parts.pop("most", 1))
    return jvr.Scene(volume, parts.pop("transfer", CLEAR), surfaces=surfaces, **parts)


def fresnel(degrees, n):
    """Of light that comes to a medium of index `n`, 1 where all is reflected."""
    i = np.radians(degrees)
    c = np.sqrt(np.maximum(1 - (np.sin(i) / n) ** 2, 0))
    s, p = (np.cos(i) - n * c) / (np.cos(i) + n * c), (n * np.cos(i) - c) / (n * np.cos(i) + c)
    return np.where(np.sin(i) > n, 1.0, (s**2 + p**2) / 2)


@pytest.mark.slow
def test_a_plane_mirror_shows_the_sky_in_the_mirrored_direction():
    """In front of its own colour and behind what of the medium is in front of it, there and back again."""
    grey = (0.3, 0.3, 0.3)
    fog = jvr.LinearTransfer([-40.0, 40.0], [grey] * 2, np.full(2, 0.02))
    scene = planes([2.75], [[0.9, 0.1, 0.2]], background=sky(), transfer=fog, specular=jvr.Specular(0.6, order=1))
    found = picture_at(scene, 20)
    a = np.radians(20)
    seen = np.asarray(sky().radiance([[-np.sin(a), 0.0, np.cos(a)]]))[0]
    T = np.exp(-0.02 * (8 - 2.75) / np.cos(a))
    mirrored = (1 - T) * 0.3 + T * seen
    np.testing.assert_allclose(found.rgb[1, 2], (1 - T) * 0.3 + T * (0.6 * mirrored + 0.4 * np.array([0.9, 0.1, 0.2])), rtol=1e-5)
    # A mirror is opaque, and where it is, whatever is seen in it.
    np.testing.assert_allclose(found.alpha, 1, rtol=1e-6)


def picture_at(scene, degrees, **choices):
    return render(scene, tilted(scene.volume, degrees, **choices), SETTINGS)


@pytest.mark.slow
def test_without_an_order_nothing_of_it_is_in_the_program():
    """But for its numbers, which nothing reads."""
    scene = planes([2.75], [[0.9, 0.1, 0.2]])
    camera = tilted(scene.volume, 20)
    trace = lambda scene: str(
        jax.make_jaxpr(lambda t: jvr.render(eqx.tree_at(lambda s: s.transfer, scene, t), camera).rgb)(CLEAR)
    )
    operations = lambda scene: collections.Counter(re.findall(r" = (\w+)", trace(scene)))
    none, one = (dataclasses.replace(scene, specular=jvr.Specular(0.6, order=order)) for order in (0, 1))
    assert operations(none) == operations(scene)
    assert operations(one) != operations(scene)


@pytest.mark.slow
def test_between_two_mirrors_brightness_is_a_geometric_series():
    """`L_k` is the sum of `w^j (1 - w) c_j` over the first `k` mirrors, and what is left of the next one's colour, `w^k c_k`; so the
    difference between one order and the next falls as `w^k`."""
    w, colours = np.array([0.7, 0.8]), np.array([[1.0, 0.2, 0.1], [0.1, 0.3, 1.0]])
    inside = tilted(jvr.Volume(ramp()), 2.0, eye=[3.5, 3.5, 4.0])
    previous = None
    for order in (1, 2, 5):
        scene = planes([1.0, 7.0], colours, specular=jvr.Specular(w, order=order))
        wanted, share = np.zeros(3), 1.0
        for j in range(order):
            wanted, share = wanted + share * (1 - w[j % 2]) * colours[j % 2], share * w[j % 2]
        wanted = wanted + share * colours[order % 2]
        found = render(scene, inside, SETTINGS).rgb[1, 1]
        np.testing.assert_allclose(found, wanted, rtol=2e-6)
        if previous is not None:
            assert np.abs(found - previous).max() <= 0.7 * 0.8 ** (order - 2)
        previous = found


def textured(z):
    """A large square behind the volume, whose red grows with the first coordinate."""
    corners = np.array([[-40.0, -40, z], [60, -40, z], [60, 60, z], [-40, 60, z]])
    return jvr.Mesh(corners, [[0, 1, 2], [0, 2, 3]], np.stack([(corners[:, 0] + 40) / 100] * 3, axis=1))


SLAB = -np.abs(ramp() - 4)


@pytest.mark.slow
@pytest.mark.parametrize("index", [1.5, 0.8])
def test_a_glass_slab_shifts_rays_and_leaves_their_direction(index):
    """By `h sin(phi - theta) / cos theta` across the ray; what it lets through is Fresnel's for both of its faces, and what of the first is
    mirrored, black here. One program for all angles and indices."""
    scene = planes(
        [-2.5], [[0, 0, 0]], [0.0], volume=jvr.Volume(SLAB), geometry=textured(-5.0), specular=jvr.Specular(index=index)
    )
    for phi in (0.0, 15.0, 35.0):
        a = np.radians(phi)
        theta = np.arcsin(np.sin(a) / index)
        found = np.asarray(picture_at(scene, phi, size=2, extent=0.2).rgb)[..., 0] / (1 - fresnel(phi, index)) ** 2
        across = np.array([[-0.05, 0.05]])
        # Where rays through the middle of the volume meet the square, and across it the shift over the cosine.
        straight = 3.5 - 9 * np.tan(a) + np.asarray(across) / np.cos(a)
        shift = 5 * np.sin(a - theta) / np.cos(theta) / np.cos(a)
        assert np.ptp(found[:, 0]) < 1e-6
        np.testing.assert_allclose(100 * found[0] - 40, np.sort(straight[0] + shift), atol=2e-4)


@pytest.mark.slow
def test_a_glaze_reflects_as_fresnel_says_and_all_beyond_the_critical_angle():
    """On an opaque surface under an even sky the picture is the reflected fraction, of either index in one program."""
    below = jvr.Volume(8 - ramp())
    scene = planes([4.0], [[0, 0, 0]], volume=below, background=(1.0, 1.0, 1.0), specular=jvr.Specular(index=1.5, order=1))
    for index in (1.5, 1 / 1.5):
        of_index = eqx.tree_at(lambda s: s.specular.index, scene, jnp.asarray(index))
        for phi in (0.0, 30.0, 41.7, 41.9, 60.0):
            np.testing.assert_allclose(
                picture_at(of_index, phi, size=2, extent=0.1).rgb, fresnel(phi, index), rtol=2e-4, atol=1e-6
            )


def ball(n=21):
    """A ball that splines hold exactly, far from the border: squares of distances from its middle."""
    middle = (n - 1) / 2
    squares = -np.sum(np.square(np.indices((n, n, n)) - middle), axis=0)
    return jvr.Volume(squares, interpolation=jvr.Tricubic()).prefiltered()


def through_ball(y, n, radius, behind):
    """Where a ray of height `y` along the axis crosses a plane `behind` the middle of a ball."""
    x = -np.sqrt(radius**2 - y**2)
    p, d = np.array([x, y]), np.array([1.0, 0.0])
    for eta, normal in ((1 / n, p / radius), (n, None)):
        outward = p / radius if normal is not None else -p / radius
        c = -d @ outward
        d = eta * d + (eta * c - np.sqrt(1 - eta**2 * (1 - c**2))) * outward
        if normal is not None:
            p = p - 2 * (p @ d) * d
    return p[1] + (behind - p[0]) / d[0] * d[1]


@pytest.mark.slow
def test_a_ball_focuses_at_n_r_over_twice_n_less_one():
    """Near the axis rays meet there, and everywhere they go where tracing them through a sphere says."""
    n, radius = 1.5, 4.0
    focus = n * radius / (2 * (n - 1))
    assert abs(through_ball(1e-3, n, radius, focus)) < 1e-8
    surfaces = jvr.Isosurfaces([-(radius**2)], [[0, 0, 0]], [0.0], most=1)
    scene = jvr.Scene(ball(), CLEAR, surfaces=surfaces, geometry=textured(10 - focus), specular=jvr.Specular(0.0, index=n))
    heights = (np.arange(8) - 3.5) / 8 * 3
    found = np.asarray(picture_at(scene, 0.0, size=8, extent=3.0).rgb)[4, :, 0] * 100 - 40 - 10
    wanted = np.sort([np.sign(y) * through_ball(abs(y), n, radius, focus) for y in heights])
    np.testing.assert_allclose(np.sort(found), wanted, atol=5e-3)
    assert np.abs(found[3:5]).max() < 5e-3


@pytest.mark.slow
def test_an_index_of_one_is_not_seen():
    """Also where rays graze the surface, and also in the medium, whose segments begin anew behind it."""
    fog = jvr.LinearTransfer([-60.0, 0.0], [[0.3, 0.6, 0.2], [0.9, 0.5, 0.3]], [0.0, 0.1])
    surfaces = jvr.Isosurfaces([-16.0], [[0.5, 0.4, 0.3]], [0.4], most=2)
    volume = jvr.Volume(-np.sum(np.square(np.indices((13, 13, 13)) - 6.0), axis=0))
    scene = jvr.Scene(volume, fog, surfaces=surfaces, background=sky())
    camera = jvr.PerspectiveCamera.look_at([30, -8, 14], [6, 6, 6], [0, 0, 1], 25, 12, 12)
    fine = jvr.Settings(0.1, termination=0)
    plain, glass = (render(dataclasses.replace(scene, specular=part), camera, fine) for part in (None, jvr.Specular(index=1.0)))
    for a, b in ((plain.rgb, glass.rgb), (plain.alpha, glass.alpha), (0.05 * plain.depth, 0.05 * glass.depth)):
        np.testing.assert_allclose(a, b, atol=2e-3)


def smooth(shape=(8, 9, 8)):
    x, y, z = np.indices(shape).astype(float)
    return np.sin(0.5 * x + 0.3) + np.cos(0.45 * y) + 0.3 * z - 0.05 * x * z


@pytest.mark.slow
@pytest.mark.parametrize("opacity", [None, (0.3, 0.2)], ids=["mirrors", "glass"])
def test_derivatives_match_differences(x64, opacity):
    """In index, reflectance, isovalues, voxels, sky and pose, in both modes and under `vmap`, at pixels whose paths meet the same surfaces
    on both sides of the difference."""
    surfaces = jvr.Isosurfaces([0.6, 1.7], [[0.9, 0.4, 0.2], [0.2, 0.5, 0.9]], opacity, tolerance=1e-6, most=1)
    transfer = jvr.LinearTransfer([-1, 3], [[0.3, 0.8, 0.2], [0.9, 0.3, 0.5]], [0.02, 0.1])
    specular = jvr.Specular([0.6, 0.8], order=1) if opacity is None else jvr.Specular(index=[1.3, 1.2], order=2)
    volume = jvr.Volume(smooth(), interpolation=jvr.Tricubic())
    scene = jvr.Scene(volume, transfer, background=sky(), surfaces=surfaces, specular=specular)
    camera = jvr.PerspectiveCamera.look_at([20, -9, 12], [3.5, 4, 3.5], [0, 0, 1], 24, 6, 6)
    where = lambda s, c: (s.surfaces, s.specular, s.volume.values, s.background.pixels, c.world_from_camera)
    base, rng = where(scene, camera), np.random.default_rng(0)
    tangents = jax.tree.map(lambda x: jnp.asarray(0.5 * rng.normal(size=x.shape)), base)
    tangents = (*tangents[:-1], tangents[-1].at[3].set(0))

    def seen(arrays):
        s, c = eqx.tree_at(lambda sc: where(*sc), (scene, camera), arrays)
        found = jvr.render(s, c, SETTINGS)
        return jnp.concatenate([found.rgb, found.alpha[..., None], 0.05 * found.depth[..., None]], axis=-1)

    at, h = jax.jit(seen), 1e-6
    moved = lambda h: at(jax.tree.map(lambda x, t: x + h * t, base, tangents))
    difference, twice = ((moved(k) - moved(-k)) / (2 * k) for k in (h, 2 * h))
    steady = np.all(np.isclose(difference, twice, rtol=1e-3, atol=1e-4) & (np.abs(difference) < 30), axis=-1)
    assert steady.mean() > 0.6
    along = jax.jit(lambda t: jax.jvp(seen, (base,), (t,))[1])(tangents)
    np.testing.assert_allclose(np.asarray(along)[steady], np.asarray(difference)[steady], rtol=5e-4, atol=5e-5)
    weights = jnp.asarray(rng.normal(size=along.shape) * steady[..., None])
    pull = jax.jit(jax.vmap(lambda w: jax.vjp(seen, base)[1](w)[0]))
    once, thrice = (jax.tree.map(lambda x, i=i: x[i], pull(jnp.stack([weights, -3 * weights]))) for i in (0, 1))
    products = lambda gradient: sum(jnp.sum(g * t) for g, t in zip(*map(jax.tree.leaves, (gradient, tangents)), strict=True))
    np.testing.assert_allclose(products(once), jnp.sum(weights * along), rtol=1e-7)
    np.testing.assert_allclose(thrice[2], -3 * once[2], rtol=1e-7, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("adjoint", [jvr.Replay(), jvr.Rows(), jvr.Forward()], ids=["replay", "rows", "forward"])
def test_every_adjoint_has_the_derivative_of_a_mirror(x64, adjoint):
    """In its reflectance: what it mirrors less what it hides, through the fog in front of it."""
    fog = jvr.LinearTransfer([-40.0, 40.0], np.full((2, 3), 0.3), np.full(2, 0.02))
    scene = planes([2.75], [[0.9, 0.1, 0.2]], background=(0.2, 0.5, 0.7), transfer=fog, specular=jvr.Specular(0.6, order=1))
    camera, settings = tilted(scene.volume, 0, size=1, extent=0.1), dataclasses.replace(SETTINGS, adjoint=adjoint)

    def seen(w):
        return jvr.render(eqx.tree_at(lambda s: s.specular.reflectance, scene, w), camera, settings).rgb[0, 0, 0]

    slope = (jax.jacfwd if isinstance(adjoint, jvr.Forward) else jax.grad)(seen)
    T = np.exp(-0.02 * (8 - 2.75))
    np.testing.assert_allclose(jax.jit(slope)(jnp.asarray(0.6)), T * ((1 - T) * 0.3 + T * 0.2 - 0.9), rtol=1e-6)


@pytest.mark.slow
def test_extremes_are_finite():
    """Index 1, grazing rays, an eye inside a surface, a plateau at the isovalue, an opaque medium, a lamp: values and derivatives."""
    plateau = np.clip(-np.sum(np.square(np.indices((9, 9, 9)) - 4.0), axis=0), -9.0, -4.0)
    surfaces = jvr.Isosurfaces([-9.0, -4.0], [[0.5, 0.4, 0.3]] * 2, [0.4, 0.0], most=1)
    lamp = jvr.EnvironmentMap(np.where(np.arange(32).reshape(4, 8, 1) == 9, 1e4, 0.1) * np.ones(3))
    fog = jvr.LinearTransfer([-60.0, 0.0], np.full((2, 3), 0.5), [0.0, 0.1])
    scene = jvr.Scene(jvr.Volume(plateau), fog, surfaces=surfaces, background=lamp, specular=jvr.Specular(index=1.5))
    outside = jvr.OrthographicCamera.look_at([24, 4, 4], [4, 4, 4], [0, 0, 1], 8.0, 9, 9)
    inside = dataclasses.replace(outside, world_from_camera=outside.world_from_camera.at[0, 3].set(4.2))

    def loss(inputs, rest, camera):
        return jnp.mean(jvr.render(eqx.combine(inputs, rest), camera, SETTINGS).rgb)

    inputs, rest = eqx.partition(scene, eqx.is_inexact_array)
    found = jax.jit(jax.value_and_grad(lambda inputs, camera: loss(inputs, rest, camera), argnums=(0, 1)))
    for index in (1.0, 1.5, 1 / 1.5, 1e3):
        for sigma in (0.1, 1e6):
            for camera in (outside, inside):
                case = eqx.tree_at(
                    lambda s: (s.specular.index, s.transfer.sigma_t), inputs, (jnp.float32(index), jnp.float32([0, sigma]))
                )
                for leaf in jax.tree.leaves(found(case, camera)):
                    assert np.all(np.isfinite(leaf)), (index, sigma)


@pytest.mark.slow
def test_the_index_of_a_glass_is_found_from_a_picture():
    """With its standard error."""
    surfaces = jvr.Isosurfaces([-12.0], [[0, 0, 0]], [0.0], most=1)
    volume = jvr.Volume(-np.sum(np.square(np.indices((11, 11, 11)) - 5.0), axis=0))
    around = jvr.EnvironmentMap.gradient((0.1, 0.1, 0.2), (0.5, 0.6, 0.7), (0.9, 0.3, 0.2), height=8)
    glass = {"surfaces": surfaces, "specular": jvr.Specular(index=1.4), "normals": jvr.CentralDifferences()}
    # Facets of the default normals would have a picture jump where rays change from one to the next.
    scene = jvr.Scene(volume, CLEAR, background=around, **glass)
    camera = jvr.PerspectiveCamera.look_at([26, -6, 13], [5, 5, 5], [0, 0, 1], 25, 12, 12)
    image = np.asarray(render(scene, camera, SETTINGS).rgb) + 1e-3 * np.random.default_rng(0).normal(size=(12, 12, 3))
    start = eqx.tree_at(lambda s: s.specular.index, scene, jnp.float32(1.3))
    found = jvr.fit(start, [camera], [image], unknowns=lambda s: s.specular.index, settings=SETTINGS)
    (error,) = jax.tree.leaves(found.standard_errors)
    assert 0 < error < 0.02
    assert abs(float(found.scene.specular.index) - 1.4) < max(4 * float(error), 5e-3)


def test_what_cannot_work_is_refused_with_a_remedy():
    with pytest.raises(ValueError, match=r"give a reflectance for mirrors, or an index such as 1\.5 for glass"):
        jvr.Specular()
    with pytest.raises(ValueError, match=r"order must be a whole number from 0 to 16"):
        jvr.Specular(0.5, order=-1)
    with pytest.raises(ValueError, match=r"set surfaces=jvr\.Isosurfaces\(\.\.\.\), or leave specular out"):
        jvr.Scene(jvr.Volume(ramp()), CLEAR, specular=jvr.Specular(0.5))
    with pytest.raises(ValueError, match=r"specular\.index has 3 entries for 2 isovalues: give one number, or one for each"):
        planes([1.0, 2.0], np.ones((2, 3)), specular=jvr.Specular(index=[1.5, 1.2, 1.1]))
    with pytest.raises(ValueError, match=r"give geometry=jvr\.Mesh"):
        planes([1.0], np.ones((1, 3)), specular=jvr.Specular(0.5), geometry=jvr.DepthImage(np.ones((2, 2)), np.ones((2, 2, 3))))
    with pytest.raises(ValueError, match=r"normals=\.\.\.\(of_opacity=False\)"):
        planes([1.0], np.ones((1, 3)), specular=jvr.Specular(0.5), normals=jvr.CentralDifferences(of_opacity=True))


def test_a_configuration_has_all_of_it():
    """`[specular]`, whose kind goes without saying; what is wrong in it is said with its key."""
    tables = {"volume": {"builtin": "demo"}, "transfer": {"kind": "window"}}
    tables |= {"surfaces": {"values": [0.2, 0.5], "rgb": [[1, 0, 0], [0, 1, 0]]}}
    given = {"reflectance": 0.5, "index": [1.5, 1.3], "order": 3}
    made = build_scene(config_from(tables | {"specular": given}, "a.toml", Path(), ())).specular
    assert eqx.tree_equal(made, jax.tree.map(jnp.asarray, jvr.Specular(**given)))
    with pytest.raises(ConfigError, match=r"specular\.index"):
        build_scene(config_from(tables | {"specular": given | {"index": [1.5, -1.0]}}, "a.toml", Path(), ()))
    with pytest.raises(ConfigError, match=r"specular: there is no surface to be specular; add \[surfaces\]"):
        config_from({k: v for k, v in tables.items() if k != "surfaces"} | {"specular": given}, "a.toml", Path(), ())


def test_plan_and_knobs_know_it():
    mirror = planes([1.0], np.ones((1, 3)), specular=jvr.Specular(0.5, order=3), lights=(jvr.HeadLight(),), shading=jvr.Lambert())
    glass = planes([1.0], np.ones((1, 3)), [0.0], specular=jvr.Specular(index=1.5))
    assert "mirrored, up to 3 times" in str(jvr.plan(mirror))
    assert "mirrored and bent, up to 2 times: at most 4 paths a ray" in str(jvr.plan(glass))
    (knob,) = glass.specular.knobs(glass)
    assert (knob.values, knob.reference) == ((0, 1, 2), 3)
    assert any("HeadLight shines along mirrored rays" in said for said in mirror.specular.remarks("specular", mirror, None))
    assert glass.replaced(surfaces=None).specular is None
    assert glass.specular.without(glass).specular is None
