"""Lit scenes whose picture is known in closed form: slabs, surfaces, lights; and what a lit picture must not depend on."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import OBLIQUE, linear_transfer, perspective, render, rotation, voxels

import jvr
from jvr.march.medium import AbstractVisibility
from jvr.march.steps import Transmittances
from jvr.model.effects import AbstractShadows
from jvr.model.light import AbstractLight

LENGTH, SIGMA = 8.0, 0.3
COLOUR = np.array([0.9, 0.5, 0.2])
# Lights of unit irradiance: along the view, against it, and across at several angles. The eye looks along -x.
DIRECTIONS = {"front": (-1, 0, 0), "behind": (1, 0, 0), "oblique": (-0.6, 0.64, 0.48), "oblique, behind": (0.5, 0.3, -0.8)}
EXACT = jvr.ShadowRays(4.0, termination=0)
FINE = jvr.Settings(0.02, termination=0)


def slab(values=1.0, size=100.0):
    """`LENGTH` thick along x and so wide that light in no direction used here enters from the side; the world's origin is in the middle of
    the side that light from behind enters through."""
    affine = np.diag([1.0, size, size, 1.0])
    affine[1:3, 3] = -size / 2
    profile = np.broadcast_to(np.asarray(values, float), 9)
    return jvr.Volume(np.broadcast_to(profile[:, None, None], (9, 2, 2)), affine)


def view(width=1, height=1, size=1e-3):
    """Rays along -x through the middle of a slab."""
    return jvr.OrthographicCamera.look_at([LENGTH + 5, 0, 0], [0, 0, 0], [0, 0, 1], size, width, height)


def medium(sigma=SIGMA, colour=(0, 0, 0)):
    """Extinction `sigma s`, one colour."""
    sigma = np.asarray(sigma, float)
    return jvr.LinearTransfer([0.0, 1.0], [colour, colour], np.stack([0 * sigma, sigma]))


def henyey_greenstein(g, cos):
    return (1 - g * g) / (4 * math.pi * (1 + g * g - 2 * g * cos) ** 1.5)


def scattered(direction, sigma=SIGMA, length=LENGTH):
    """`int sigma exp(-tau_eye - tau_light) du` through a slab."""
    cos = direction[0] / np.linalg.norm(direction)
    m, tau = 1 / abs(cos), sigma * length
    if cos < 0:
        return -np.expm1(-tau * (1 + m)) / (1 + m)
    return np.exp(-tau * m) * (tau if m == 1 else -np.expm1(-tau * (1 - m)) / (1 - m))


def one(scene, settings=FINE, camera=None):
    """The colour of the pixel in the middle."""
    rgb = np.asarray(render(scene, view() if camera is None else camera, settings).rgb)
    return rgb[rgb.shape[0] // 2, rgb.shape[1] // 2]


# The midpoint rule on T_light: (sigma dt m)^2 / 24 with dt = 0.02 and m up to 2.
MIDPOINT = 2e-5


@pytest.mark.slow
@pytest.mark.parametrize("g", [None, 0.6, -0.4, 0.99])
def test_slab_scatters_as_its_integral_says(g, x64):
    phase = jvr.Isotropic() if g is None else jvr.HenyeyGreenstein(g)
    for direction in DIRECTIONS.values():
        light = jvr.DirectionalLight(direction, [1.0, 2.0, 0.5])
        scene = jvr.Scene(
            slab(), medium(), lights=(light,), shadows=EXACT, scattering=jvr.SingleScattering(phase, [0.8, 0.4, 1.0])
        )
        p = henyey_greenstein(g or 0.0, direction[0] / np.linalg.norm(direction))
        np.testing.assert_allclose(one(scene), p * np.array([0.8, 0.8, 0.5]) * scattered(direction), rtol=MIDPOINT)


@pytest.mark.slow
@pytest.mark.parametrize("quadrature", [jvr.Midpoint(), jvr.PreIntegrated()], ids=["midpoint", "pre-integrated"])
def test_error_of_a_lit_slab_falls_with_the_square_of_the_step(quadrature, x64):
    errors, steps = [], [0.4, 0.15, 0.05]
    scene = jvr.Scene(
        slab(),
        medium(colour=COLOUR),
        lights=(jvr.DirectionalLight(DIRECTIONS["oblique"]),),
        shadows=EXACT,
        shading=jvr.Lambert(),
        scattering=jvr.SingleScattering(),
    )
    truth = (COLOUR + 1 / (4 * math.pi)) * scattered(DIRECTIONS["oblique"])
    for step in steps:
        found = one(scene, jvr.Settings(step, termination=0, quadrature=quadrature))
        errors.append(np.abs(found - truth).max())
    order = np.polyfit(np.log(steps), np.log(errors), 1)[0]
    assert abs(order - 2) < 0.1, errors


@pytest.mark.slow
def test_light_from_the_side(x64):
    """The way of the light is the same for every point of the ray."""
    volume = slab(size=6.0)
    scene = jvr.Scene(
        volume, medium(), lights=(jvr.DirectionalLight([0, 2, 0]),), shadows=EXACT, scattering=jvr.SingleScattering()
    )
    expected = math.exp(-SIGMA * 3) * -math.expm1(-SIGMA * LENGTH) / (4 * math.pi)
    np.testing.assert_allclose(one(scene), expected, rtol=1e-12)


@pytest.mark.slow
def test_coloured_extinction_colours_the_shadow(x64):
    sigma = np.array([0.05, 0.3, 0.9])
    for direction in DIRECTIONS.values():
        scene = jvr.Scene(
            slab(), medium(sigma), lights=(jvr.DirectionalLight(direction),), shadows=EXACT, scattering=jvr.SingleScattering()
        )
        expected = [scattered(direction, s) / (4 * math.pi) for s in sigma]
        np.testing.assert_allclose(one(scene), expected, rtol=10 * MIDPOINT)


@pytest.mark.slow
def test_a_clipping_box_lets_light_in(x64):
    """What is cut away shades nothing, along the view and to the side."""
    for direction in (DIRECTIONS["front"], DIRECTIONS["oblique, behind"]):
        box = jvr.ClippingBox([2.0, -20, -20], [6.5, 20, 20])
        scene = jvr.Scene(
            slab(),
            medium(),
            clipping=box,
            lights=(jvr.DirectionalLight(direction),),
            shadows=EXACT,
            scattering=jvr.SingleScattering(),
        )
        expected = scattered(direction, length=4.5) / (4 * math.pi)
        np.testing.assert_allclose(one(scene), expected, rtol=MIDPOINT)
    scene = jvr.Scene(
        slab(),
        medium(),
        clipping=jvr.ClippingBox([-1, -1.5, -2], [9, 2, 2]),
        lights=(jvr.DirectionalLight([0, 1, 0]),),
        shadows=EXACT,
        scattering=jvr.SingleScattering(),
    )
    np.testing.assert_allclose(one(scene), math.exp(-SIGMA * 1.5) * -math.expm1(-SIGMA * LENGTH) / (4 * math.pi), rtol=1e-12)


@pytest.mark.slow
def test_ambient_light(x64):
    """From everywhere, unshaded: the medium scatters `albedo L`, surfaces reflect `ambient L`."""
    lights = (jvr.AmbientLight([0.5, 1.0, 2.0]),)
    alpha = -math.expm1(-SIGMA * LENGTH)
    scatters = jvr.Scene(slab(), medium(), lights=lights, scattering=jvr.SingleScattering(jvr.HenyeyGreenstein(0.3), 0.7))
    np.testing.assert_allclose(one(scatters), 0.7 * alpha * np.array([0.5, 1, 2]), rtol=1e-12)
    reflects = jvr.Scene(slab(), medium(colour=COLOUR), lights=lights, shading=jvr.Lambert(0.25))
    np.testing.assert_allclose(one(reflects), 0.25 * alpha * COLOUR * [0.5, 1, 2], rtol=1e-12)


def test_point_light_beside_a_ray(x64):
    """`int I / (4 pi r^2) sigma exp(-sigma u) du` at the distance 2 from a ray, by Gauss-Legendre quadrature."""
    light = jvr.PointLight([3.0, 2.0, 0.0], 5.0)
    scene = jvr.Scene(slab(), medium(), lights=(light,), scattering=jvr.SingleScattering())
    node, weight = np.polynomial.legendre.leggauss(200)
    x, weight = LENGTH * (node + 1) / 2, LENGTH * weight / 2
    expected = weight @ (5 / (4 + (x - 3) ** 2) * SIGMA * np.exp(-SIGMA * (LENGTH - x))) / (4 * math.pi)
    np.testing.assert_allclose(one(scene), expected, rtol=MIDPOINT)


def light_sample(light, x):
    """Direction, distance and grey irradiance at a place."""
    found = light.sample(tuple(jnp.asarray(x, float)), (jnp.asarray(1.0), jnp.asarray(0.0), jnp.asarray(0.0)))
    return np.asarray(found.w_i), float(found.distance), float(found.irradiance[0])


def test_falloff_of_a_point_light(x64):
    position = np.array([1.0, 2.0, 3.0])
    for offset in ([2.0, 0, 0], [1, -2, 3], [1e-2, 0, 0], [0, 1e5, 0], [0, 0, 0]):
        r = np.linalg.norm(offset)
        x = position + offset
        towards, distance, square = light_sample(jvr.PointLight(position, 7.0, radius=0.05), x)
        np.testing.assert_allclose(distance, r, rtol=1e-10)
        np.testing.assert_allclose(towards, -np.asarray(offset) / r if r else np.zeros(3), atol=1e-10)
        np.testing.assert_allclose(square, 7 / max(r, 0.05) ** 2, rtol=1e-10)
        _, _, polynomial = light_sample(jvr.PointLight(position, 7.0, attenuation=(0.5, 0.1, 0.02)), x)
        np.testing.assert_allclose(polynomial, 7 / (0.5 + 0.1 * r + 0.02 * r * r), rtol=1e-10)


def test_cone_of_a_spot_light(x64):
    light = jvr.SpotLight([0, 0, 0], [0, 0, -3.0], 2.0, inner=20.0, outer=40.0)
    at = lambda degrees: light_sample(light, [4 * math.sin(math.radians(degrees)), 0, -4 * math.cos(math.radians(degrees))])[2]
    for degrees in (0, 10, 19.99):
        np.testing.assert_allclose(at(degrees), 2 / 16, rtol=1e-12)
    for degrees in (40.01, 90, 180):
        assert at(degrees) == 0
    full, edge = math.cos(math.radians(20)), math.cos(math.radians(40))
    for degrees in (22, 30, 38):
        share = (math.cos(math.radians(degrees)) - edge) / (full - edge)
        np.testing.assert_allclose(at(degrees), share**2 * (3 - 2 * share) / 8, rtol=1e-12)
    # All around, and half a sphere.
    assert light_sample(jvr.SpotLight([0, 0, 0], [0, 0, 1], 1.0, inner=179.0, outer=180.0), [0, 0, -1])[2] == 0
    assert light_sample(jvr.SpotLight([0, 0, 0], [0, 0, 1], 1.0, inner=0.0, outer=90.0), [0, 0, 2.0])[2] == 0.25


RISING = slab(np.linspace(0, 1, 9))
FALLING = slab(np.linspace(1, 0, 9))


def reflected(shading, light, volume=FALLING, **options):
    """Radiance over opacity of a slab whose values fall or rise towards the eye."""
    scene = jvr.Scene(volume, medium(colour=COLOUR), shading=shading, lights=(light,), **options)
    image = render(scene, view(), jvr.Settings(0.5, termination=0))
    return np.asarray(image.rgb)[0, 0] / float(image.alpha[0, 0])


def tilted(degrees):
    """Unit irradiance that comes from the eye's side at an angle to the normal."""
    a = math.radians(degrees)
    return jvr.DirectionalLight([-math.cos(a), 0.6 * math.sin(a), 0.8 * math.sin(a)])


@pytest.mark.slow
def test_lambert_facing_a_light_returns_the_colour(x64):
    np.testing.assert_allclose(reflected(jvr.Lambert(), tilted(0)), COLOUR, rtol=1e-12)
    np.testing.assert_allclose(reflected(jvr.Lambert(), tilted(60)), 0.5 * COLOUR, rtol=1e-12)
    np.testing.assert_allclose(reflected(jvr.Lambert(diffuse=0.4), tilted(60)), 0.2 * COLOUR, rtol=1e-12)
    assert not reflected(jvr.Lambert(), tilted(120)).any()
    np.testing.assert_allclose(reflected(jvr.Lambert(), jvr.HeadLight([2.0, 1, 1])), COLOUR * [2, 1, 1], rtol=1e-12)


def test_one_side_and_two(x64):
    """The normal points to smaller values: the slab whose values rise towards the eye shows its back."""
    one_sided = jvr.Lambert(two_sided=False)
    np.testing.assert_allclose(reflected(one_sided, tilted(60)), 0.5 * COLOUR, rtol=1e-12)
    assert not reflected(one_sided, tilted(60), RISING).any()
    np.testing.assert_allclose(reflected(one_sided, tilted(120), RISING), 0.5 * COLOUR, rtol=1e-12)
    np.testing.assert_allclose(reflected(jvr.Lambert(), tilted(60), RISING), 0.5 * COLOUR, rtol=1e-12)


@pytest.mark.parametrize("kind", [pytest.param(jvr.Phong, marks=pytest.mark.slow), jvr.BlinnPhong])
def test_highlight(kind, x64):
    """In the colour of the light: at its peak `specular`, beside it the cosine of the reflected ray or of the half-way vector."""
    for shininess in (1.0, 7.0, 1e3):
        shading = kind(0.1, 0.7, 0.3, shininess)
        np.testing.assert_allclose(
            reflected(shading, jvr.HeadLight([1.0, 2.0, 3.0])), (0.7 * COLOUR + 0.3) * [1, 2, 3], rtol=1e-12
        )
        for degrees in (10, 40, 80):
            angle = math.radians(degrees if kind is jvr.Phong else degrees / 2)
            expected = 0.7 * math.cos(math.radians(degrees)) * COLOUR + 0.3 * math.cos(angle) ** shininess
            np.testing.assert_allclose(reflected(shading, tilted(degrees)), expected, rtol=1e-11)
        assert not reflected(shading, tilted(100)).any()


@pytest.mark.slow
def test_no_gradient_reflects_as_if_facing(x64):
    """Wherever the light comes from, without a highlight, with any threshold."""
    for threshold in (0.0, 0.1):
        shading = jvr.BlinnPhong(0.1, 0.7, 0.3, 20.0, threshold=threshold)
        for light in (tilted(60), tilted(140)):
            np.testing.assert_allclose(reflected(shading, light, slab()), 0.7 * COLOUR, rtol=1e-12)


def test_threshold_blends(x64):
    """The gradient of these slabs is 1/8 everywhere."""
    t = 0.2
    surface = 0.125**2 / (0.125**2 + t**2)
    for degrees in (60, 120):
        facing = max(math.cos(math.radians(degrees)), 0)
        expected = 0.7 * (1 + surface * (facing - 1)) * COLOUR
        np.testing.assert_allclose(reflected(jvr.Lambert(0.1, 0.7, threshold=t), tilted(degrees)), expected, rtol=1e-12)
        expected = expected + surface * (0.3 * math.cos(math.radians(degrees / 2)) ** 9 if degrees < 90 else 0)
        np.testing.assert_allclose(
            reflected(jvr.BlinnPhong(0.1, 0.7, 0.3, 9.0, threshold=t), tilted(degrees)), expected, rtol=1e-12
        )


@pytest.mark.slow
def test_switch_between_surface_and_medium(x64):
    """With a threshold the share `t^2 / (m^2 + t^2)` scatters and the rest reflects; without, both are added."""
    t, phase = 0.2, jvr.HenyeyGreenstein(0.5)
    scatters = t**2 / (0.125**2 + t**2)
    p = henyey_greenstein(0.5, -0.5)
    for threshold, s, r in ((t, scatters, 1 - scatters), (None, 1.0, 1.0)):
        found = reflected(jvr.Lambert(), tilted(60), scattering=jvr.SingleScattering(phase, 0.8, threshold=threshold))
        np.testing.assert_allclose(found, r * 0.5 * COLOUR + s * 0.8 * p, rtol=1e-12)
    # In a homogeneous medium nothing is a surface.
    found = reflected(jvr.Lambert(), tilted(60), slab(), scattering=jvr.SingleScattering(phase, 0.8, threshold=t))
    np.testing.assert_allclose(found, 0.8 * p, rtol=1e-12)


@pytest.mark.slow
def test_materials_by_scalar(x64):
    """A `ByValue` is what a number would be where the scalar is such."""
    by_value = lambda low, high: jvr.ByValue([0.0, 1.0], [low, high])
    for s in (0.0, 0.25, 1.0):
        at = lambda low, high, s=s: low + s * (high - low)
        volume = slab(s)
        many = jvr.Scene(
            volume,
            jvr.LinearTransfer([0.0, 1.0], [COLOUR, COLOUR], [0.2, 0.2]),
            lights=(tilted(30), jvr.AmbientLight(0.3)),
            shading=jvr.Lambert(by_value(0.1, 0.9), by_value(0.8, 0.2)),
            scattering=jvr.SingleScattering(jvr.HenyeyGreenstein(by_value(-0.5, 0.7)), by_value(1.0, 0.1)),
        )
        p = henyey_greenstein(at(-0.5, 0.7), -math.cos(math.radians(30)))
        expected = COLOUR * (at(0.8, 0.2) + 0.3 * at(0.1, 0.9)) + at(1.0, 0.1) * (p + 0.3)
        np.testing.assert_allclose(one(many), expected * -math.expm1(-0.2 * LENGTH), rtol=1e-10)


@pytest.mark.slow
def test_shadow_of_a_cube_on_a_plane(x64):
    """A thin screen, z < 2, under an opaque cube, x and y in 4 ... 8, z in 6 ... 9; light from above at 45 degrees; seen from below.

    Voxels are constant cells, so that all of this is sharp: a line of sight is dark where the light's way to its whole part of the screen
    is blocked, and as a slab where none is."""
    values = np.zeros((20, 12, 12))
    values[:, :, :2] = 1
    values[4:8, 4:8, 6:9] = 2
    volume = jvr.Volume(values, interpolation=jvr.Nearest())
    sigma = 0.1
    transfer = jvr.LinearTransfer([0.0, 1.0, 2.0], np.zeros((3, 3)), [0.0, sigma, 1e4])
    light = jvr.DirectionalLight([1.0, 0.0, -1.0], 3.0)
    # A cell of voxel i is i - 1/2 ... i + 1/2; the domain begins at 0.
    low, high, top = np.array([3.5, 3.5, 5.5]), np.array([7.5, 7.5, 8.5]), 1.5
    camera = jvr.OrthographicCamera.look_at([9.5, 5.5, -5], [9.5, 5.5, 0], [0, 1, 0], 11, 38, 22)
    scene = jvr.Scene(volume, transfer, lights=(light,), shadows=jvr.ShadowRays(0.1), scattering=jvr.SingleScattering())
    rgb = np.asarray(render(scene, camera, jvr.Settings(0.1, termination=0)).rgb)[..., 0]
    bright = 3 / (4 * math.pi) * scattered([1, 0, 1], sigma, top)
    origin, _ = (np.stack(a, -1).reshape(22, 38, 3) for a in camera.rays(jnp.arange(22 * 38)))
    x, y = origin[..., 0], origin[..., 1]
    # Light through (x, y, z) was at (x + z) - h at the height h.
    hits = lambda x, margin: (x > low[0] + low[2] - margin) & (x < high[0] + high[2] + margin)
    across = lambda margin: (y > low[1] - margin) & (y < high[1] + margin)
    # From one side of the screen to the other.
    blocked = hits(x, -0.1) & hits(x + top, -0.1) & across(-0.1)
    free = ~(hits(x, 0.1) | hits(x + top, 0.1)) | ~across(0.1)
    # Light that enters through the side of the screen has had less of it.
    free &= x > top
    assert blocked.sum() > 20
    assert free.sum() > 200
    assert np.abs(rgb[blocked]).max() < 1e-3 * bright
    # Midpoint samples of a sharp screen: a tenth of its 1.5 either way, half of that on average.
    np.testing.assert_allclose(rgb[free], bright, rtol=0.02)


@pytest.mark.slow
def test_soft_shadows_converge_as_samples_do(x64):
    """An opaque half-space hides half of a ball, or of a disc, from a point in a thin medium. The error over many keys falls as
    one over the square root of the samples; its mean does not grow with them."""
    values = np.zeros((3, 21, 3))
    values[:, 10:, :] = 1
    # Cells are 1 long: x and z in 0 ... 2, the half-space in y > 9.5.
    volume = jvr.Volume(
        values, np.array([[1, 0, 0, -1], [0, 1, 0, -9.5], [0, 0, 1, 8], [0, 0, 0, 1.0]]), interpolation=jvr.Nearest()
    )
    transfer = jvr.LinearTransfer([0.0, 1.0], np.zeros((2, 3)), [1e-6, 1e4])
    camera = jvr.OrthographicCamera.look_at([5, -1e-3, 8.01], [0, -1e-3, 8.01], [0, 0, 1], 1e-4, 1, 1)

    def errors(make, n):
        def radiance(key):
            scene = jvr.Scene(
                volume,
                transfer,
                lights=make(jnp.array([0.0, 0.0, 20.0]), key, n),
                shadows=jvr.ShadowRays(0.25),
                scattering=jvr.SingleScattering(),
            )
            return jvr.render(scene, camera, jvr.Settings(2.0)).rgb[0, 0, 0]

        found = jax.jit(lambda keys: jax.lax.map(radiance, keys))(jax.random.split(jax.random.key(7), 100))
        return found / (2e-6 / (4 * math.pi) * 144 / 12**2) - 0.5

    sphere = lambda position, key, n: jvr.sphere_light(position, 1.0, 144.0, key=key, samples=n)
    disc = lambda position, key, n: jvr.disc_light(position, [0, 0, -1], 1.0, 144.0, key=key, samples=n)
    few, many, across = errors(sphere, 1), errors(sphere, 4), errors(disc, 4)
    # Binomial: 1 / (2 sqrt n), known to 7 % from 100 keys.
    np.testing.assert_allclose([np.std(few), np.std(many), np.std(across)], [0.5, 0.25, 0.25], rtol=0.25)
    assert max(abs(np.mean(many)), abs(np.mean(across))) < 4 * 0.5 / math.sqrt(400)


@pytest.mark.slow
def test_samples_of_area_lights():
    """Positions are uniform on the ball and on the disc, and intensities add up."""
    position, key = np.array([1.0, 2.0, 3.0]), jax.random.key(3)
    n = 600
    ball = np.array([light.position for light in jvr.sphere_light(position, 2.0, [1.0, 2.0, 4.0], key=key, samples=n)]) - position
    np.testing.assert_allclose(np.linalg.norm(ball, axis=1), 2, rtol=1e-5)
    # Archimedes: each coordinate is uniform in -2 ... 2, of variance 4/3.
    assert np.abs(ball.mean(0)).max() < 4 * math.sqrt(4 / 3 / n)
    np.testing.assert_allclose((ball**2).mean(0), 4 / 3, rtol=0.15)
    axis = np.array([0.48, -0.6, 0.64])
    lights = jvr.disc_light(position, 5 * axis, 2.0, [1.0, 2.0, 4.0], key=key, samples=n)
    disc = np.array([light.position for light in lights]) - position
    assert np.abs(disc @ axis).max() < 1e-5
    radius = np.linalg.norm(disc, axis=1)
    assert radius.max() <= 2 + 1e-5
    # Uniform in area: the square of the radius is uniform in 0 ... 4.
    np.testing.assert_allclose((radius**2).mean(), 2, rtol=0.1)
    assert np.abs(disc.mean(0)).max() < 4 / math.sqrt(n)
    np.testing.assert_allclose(np.sum([light.intensity for light in lights], 0, float), [1, 2, 4], rtol=1e-6)


def lit_scene(matrix=OBLIQUE, turn=np.eye(4), scale=1.0, shadows=jvr.ShadowRays(), **options):
    """Every kind of light and all effects, with the world turned by `turn` and in a unit `1 / scale` of the first."""
    place = lambda x: scale * (turn[:3, :3] @ np.asarray(x, float))
    world = turn @ matrix
    world[:3] *= scale
    transfer = linear_transfer()
    center = np.asarray(jvr.Volume(voxels(), OBLIQUE).center)
    lights = (
        jvr.DirectionalLight(turn[:3, :3] @ [1.0, 0.5, -0.3], [0.5, 0.7, 0.9]),
        jvr.PointLight(place(center + np.array([9, -7, 8])), 100 * scale**2),
        jvr.SpotLight(place(center + np.array([-8, 9, 4])), turn[:3, :3] @ [8.0, -9, -3], 150 * scale**2, inner=5.0, outer=25.0),
        jvr.HeadLight(0.3),
        jvr.AmbientLight(0.2),
    )
    return jvr.Scene(
        jvr.Volume(voxels(), world),
        jvr.LinearTransfer(transfer.positions, transfer.rgb, np.asarray(transfer.sigma_t) / scale),
        lights=lights,
        shading=jvr.BlinnPhong(threshold=0.05 / scale),
        shadows=shadows,
        scattering=jvr.SingleScattering(jvr.HenyeyGreenstein(0.4), 0.8, threshold=0.1 / scale),
        **options,
    )


@pytest.mark.slow
def test_turning_everything_and_the_unit_of_length_change_nothing(x64):
    settings = jvr.Settings(0.5, termination=0)
    volume = jvr.Volume(voxels(), OBLIQUE)
    pose = np.asarray(perspective(volume).world_from_camera)
    camera = lambda pose: jvr.PerspectiveCamera(pose, 38.0, 6, 5)
    expected = np.asarray(render(lit_scene(), camera(pose), settings).rgb)
    assert expected.std() > 0.01
    turn = np.eye(4)
    turn[:3, :3] = rotation(0.7, -1.1, 2.0)
    turned = render(lit_scene(turn=turn), camera(turn @ pose), settings)
    np.testing.assert_allclose(turned.rgb, expected, rtol=1e-9, atol=1e-12)
    in_metres = pose.copy()
    in_metres[:3, 3] *= 1e-3
    small = render(lit_scene(scale=1e-3), camera(in_metres), settings)
    np.testing.assert_allclose(small.rgb, expected, rtol=1e-9, atol=1e-12)


@pytest.mark.slow
def test_world_that_is_mirrored_with_its_grid(x64):
    """The same world described by a grid whose first axis runs the other way."""
    settings = jvr.Settings(0.5, termination=0)
    volume = jvr.Volume(voxels(), OBLIQUE)
    expected = np.asarray(render(lit_scene(), perspective(volume), settings).rgb)
    flip = np.diag([-1.0, 1, 1, 1])
    flip[0, 3] = 4
    scene = lit_scene()
    object.__setattr__(scene, "volume", jvr.Volume(voxels()[::-1], OBLIQUE @ flip))
    np.testing.assert_allclose(render(scene, perspective(volume), settings).rgb, expected, rtol=1e-9, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("normals", [jvr.AnalyticGradient(of_opacity=True), jvr.CentralDifferences()])
def test_pre_integrated_segments_know_every_kind_of_normal(normals):
    """Traced alone: the types of what shaders hand on are checked then."""
    scene = lit_scene(normals=normals, shadows=jvr.ShadowRays(2.0))
    picture = jax.eval_shape(jvr.render, scene, perspective(scene.volume, 3, 2), jvr.Settings(quadrature=jvr.PreIntegrated()))
    assert picture.rgb.shape == (2, 3, 3)


@pytest.mark.slow
def test_pre_integrated_segments_converge_to_the_same_lit_picture(x64):
    """With normals that are continuous; those of the interpolant jump from cell to cell."""
    scene = lit_scene(normals=jvr.CentralDifferences(), shadows=jvr.ShadowRays(2.0))
    camera = perspective(scene.volume, 3, 2)
    settings = lambda step, **options: jvr.Settings(step, termination=0, **options)
    exact = np.asarray(render(scene, camera, settings(0.02)).rgb)
    pre_integrated = [render(scene, camera, settings(step, quadrature=jvr.PreIntegrated())).rgb for step in (0.4, 0.1)]
    errors = [np.sqrt(np.mean((np.asarray(rgb) - exact) ** 2)) / exact.max() for rgb in pre_integrated]
    assert errors[1] < 0.25 * errors[0], errors
    assert errors[1] < 2e-3, errors


@pytest.mark.parametrize(
    ("make", "message"),
    {
        "direction": (lambda: jvr.DirectionalLight([0, 0, 0]), "must have a direction"),
        "spot": (lambda: jvr.SpotLight([0, 0, 0], [0, 0, 0]), "must have a direction"),
        "disc": (lambda: jvr.disc_light([0, 0, 0], [0, 0, 0], 1.0, 1.0, key=jax.random.key(0)), "must have a direction"),
        "direction that is not a number": (lambda: jvr.DirectionalLight([np.nan, 0, 1]), "must have a direction"),
        "irradiance": (lambda: jvr.DirectionalLight([0, 0, 1], -1.0), "irradiance must be finite and not negative"),
        "intensity": (lambda: jvr.PointLight([0, 0, 0], [1.0, np.inf, 0]), "intensity must be finite"),
        "radiance": (lambda: jvr.AmbientLight(-0.1), "radiance must be finite"),
        "position": (lambda: jvr.PointLight([0, np.inf, 0]), "position must be finite"),
        "radius": (lambda: jvr.PointLight([0, 0, 0], radius=0.0), "radius must be positive"),
        "ball": (lambda: jvr.sphere_light([0, 0, 0], 0.0, 1.0, key=jax.random.key(0)), "radius must be positive"),
        "attenuation": (
            lambda: jvr.PointLight([0, 0, 0], attenuation=(0, 1, 1)),
            "attenuation must be positive",
        ),
        "cone": (lambda: jvr.SpotLight([0, 0, 0], [0, 0, 1], inner=30.0, outer=30.0), "inner < outer"),
        "albedo below 0": (lambda: jvr.SingleScattering(albedo=-0.1), r"albedo must be in \[0, 1\]"),
        "albedo above 1": (lambda: jvr.SingleScattering(albedo=[0.5, 1.1, 0.5]), r"albedo must be in \[0, 1\]"),
        "albedo by value": (lambda: jvr.SingleScattering(albedo=jvr.ByValue([0, 1], [0.5, -0.1])), r"albedo must be in \[0, 1\]"),
        "threshold of scattering": (lambda: jvr.SingleScattering(threshold=0.0), "positive"),
        "threshold of shading": (lambda: jvr.Lambert(threshold=-1.0), "not negative"),
        "g": (lambda: jvr.HenyeyGreenstein(1.0), "between -1 and 1"),
        "g by value": (lambda: jvr.HenyeyGreenstein(jvr.ByValue([0, 1], [0.0, -1.0])), "between -1 and 1"),
        "diffuse": (lambda: jvr.Lambert(diffuse=-0.5), "diffuse must be finite and not negative"),
        "shininess": (lambda: jvr.Phong(shininess=0.5), "at least 1"),
        "positions by value": (lambda: jvr.ByValue([0, 0], [1, 1]), "strictly increasing"),
        "shadows without light": (
            lambda: jvr.Scene(slab(), medium(), shading=jvr.Lambert(), lights=(jvr.HeadLight(),), shadows=jvr.ShadowRays()),
            "no light that casts them",
        ),
        "shadows on nothing": (
            lambda: jvr.Scene(slab(), medium(), lights=(jvr.PointLight([0, 0, 0]),), shadows=jvr.ShadowRays()),
            "nothing shows these shadows",
        ),
    }.values(),
    ids=lambda x: x if isinstance(x, str) else "",
)
def test_what_cannot_be_right_is_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.slow
@pytest.mark.parametrize(("sigma", "least"), [(0.5, 0.989), (1.0, 0.962), (4.0, 0.778), (1e4, 0.734)])
def test_opaque_segments_are_lit_where_their_emission_comes_from(sigma, least):
    """A slab lit and seen from the front, `(1 - exp(-2 tau)) / (8 pi)` per irradiance, by segments of optical depth `sigma`: light at
    their middle would tend to 0, at the mean depth of what leaves them it tends to `2 / e` of the truth."""
    volume = jvr.Volume(np.ones((4, 4, 8), np.float32))
    camera = jvr.OrthographicCamera.look_at((1.5, 1.5, 30.0), (1.5, 1.5, 0.0), (0, 1, 0), 1.0, 2, 2)
    table = jvr.LinearTransfer([0.0, 2.0], np.zeros((2, 3)), [sigma, sigma])
    light = jvr.DirectionalLight((0.0, 0.0, -1.0))
    scene = jvr.Scene(volume, table, lights=(light,), scattering=jvr.SingleScattering(), shadows=jvr.ShadowRays(termination=0))
    radiance = np.asarray(render(scene, camera, jvr.Settings(1.0)).rgb)
    truth = -np.expm1(-14 * sigma) / (8 * np.pi)
    assert np.all(radiance >= least * truth)
    assert np.all(radiance <= truth * (1 + 1e-5))


class Fractions(AbstractVisibility):
    """Says of the first and the last of three lights, of the environment and of ambient light what fraction of them arrives."""

    def transmittances(self, points, wanted, *, reverse):
        fraction = lambda value: (jnp.full(wanted.shape, value),)
        return Transmittances((fraction(0.5), (), fraction(0.25)), environment=fraction(0.75), ambient=fraction(0.125))

    @property
    def stats(self):
        return None


class FractionalShadows(AbstractShadows):
    def visibility(self, scene, path):
        return Fractions()


@pytest.mark.slow
def test_each_light_has_a_slot_of_visibility():
    """What arrives of a light dims that light alone, wherever ambient light stands among others: pictures are linear in lights."""

    def picture(first, ambient, last, around, shadows=None):
        volume = jvr.Volume(voxels(), OBLIQUE)
        lights = (jvr.DirectionalLight((0.3, 0.5, -0.8), first), jvr.AmbientLight(ambient), jvr.HeadLight(last))
        environment = {"environment": jvr.EnvironmentLight.constant(around), "material": jvr.LambertBRDF(0.5)}
        shading = jvr.Lambert(0.3, 0.6)
        scene = jvr.Scene(volume, linear_transfer(), lights=lights, shading=shading, shadows=shadows, **environment)
        return np.asarray(render(scene, perspective(volume)).rgb)

    found = picture(1.0, 1.0, 1.0, 1.0, FractionalShadows())
    np.testing.assert_allclose(found, picture(0.5, 0.125, 0.25, 0.75), rtol=1e-5, atol=1e-6)
    assert np.max(np.abs(found - picture(0.5, 0.25, 0.125, 0.75))) > 1e-3


class Lantern(AbstractLight):
    """A light that says nothing of what arrives."""

    def moved(self, origin):
        return self


def test_lights_are_one_family():
    """All are moved with the world; one that nothing could show is refused."""
    for light in (jvr.DirectionalLight((1, 0, 0)), jvr.AmbientLight(), jvr.HeadLight(), jvr.EnvironmentLight.constant()):
        assert isinstance(light, AbstractLight)
    with pytest.raises(TypeError, match=r"nothing shows a Lantern: derive it from jvr\.model\.light\.AbstractDeltaLight"):
        jvr.Scene(slab(), medium(), lights=(Lantern(),), shading=jvr.Lambert())
