"""Every way to differentiate a rendering against every other, and against central differences, for every kind of parameter."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import OBLIQUE, gaussian_transfer, linear_transfer, lut_transfer, marched_rays, perspective, voxels

import jvr
from jvr.march.march import MarchOptions

WIDTH, HEIGHT = 5, 4

# Central differences: h^2 and the rounding of a loss near 10 divided by h leave about 1e-8. Between two ways: rounding alone.
DIFFERENCES, ROUNDING = 1e-6, 1e-11

TRANSFERS = {
    "linear": lambda: linear_transfer(),
    "linear, coloured": lambda: linear_transfer(coloured=True),
    "table": lambda: lut_transfer(),
    "table, coloured": lambda: lut_transfer(coloured=True),
    "Gaussians": lambda: gaussian_transfer(),
    "Gaussians, coloured": lambda: gaussian_transfer(coloured=True),
}


def parameters(transfer, clipped=False, parallel=False):
    """Every kind of array that a picture depends on."""
    volume = jvr.Volume(voxels((3, 4, 5)), OBLIQUE)
    center, radius = volume.center, volume.radius
    p = {
        "transfer": transfer,
        "voxels": volume.values,
        "slope": jnp.array(0.9),
        "intercept": jnp.array(0.05),
        "world_from_grid": volume.world_from_grid,
        "eye": center + radius * jnp.array([1.8, -1.1, 0.9]),
        "target": center + 0.1,
        "up": jnp.array([0.1, 0.2, 1.0]),
        "extent": 1.9 * radius if parallel else jnp.array(42.0),
        "background": jnp.array([0.2, 0.5, 0.9]),
    }
    if clipped:
        p["clipping"] = jvr.ClippingBox(center - jnp.array([1.1, 1.9, 1.3]), center + jnp.array([1.2, 1.4, 2.1]))
    return p


def picture(p, settings, parallel=False, optical=jvr.EmissionAbsorption()):
    volume = jvr.Volume(p["voxels"], p["world_from_grid"], slope=p["slope"], intercept=p["intercept"])
    kind = jvr.OrthographicCamera if parallel else jvr.PerspectiveCamera
    camera = kind.look_at(p["eye"], p["target"], p["up"], p["extent"], WIDTH, HEIGHT)
    scene = jvr.Scene(volume, p["transfer"], background=p["background"], clipping=p.get("clipping"), optical=optical)
    return jvr.render(scene, camera, settings)


def make_loss(fixed, adjoint, tile=100, quadrature=jvr.Midpoint(), **options):
    """The loss as a function of some parameters, the others being `fixed`: it touches every pixel of colour, opacity and depth,
    each with its own weight."""
    settings = jvr.Settings(0.7, termination=0, adjoint=adjoint, tile=tile, quadrature=quadrature)

    def loss(p):
        image = picture(fixed | p, settings, **options)
        wave = lambda x: jnp.sin(jnp.arange(1.0, x.size + 1)).reshape(x.shape)
        return jnp.sum(wave(image.rgb) * image.rgb**2) + jnp.sum(wave(image.alpha) * image.alpha) + jnp.sum(jnp.cos(image.depth))

    return loss


def central_differences(loss, p, h=1e-6):
    """The gradient of `loss` in every entry of `p`."""
    leaves, structure = jax.tree.flatten(p)
    ends = np.cumsum([x.size for x in leaves])[:-1]
    flat = np.concatenate([np.ravel(x) for x in leaves])
    split = lambda v: jax.tree.unflatten(structure, [a.reshape(x.shape) for a, x in zip(jnp.split(v, ends), leaves, strict=True)])
    moved = np.concatenate([flat + h * np.eye(flat.size), flat - h * np.eye(flat.size)])
    above, below = jnp.split(jax.jit(lambda v: jax.lax.map(lambda x: loss(split(x)), v))(moved), 2)
    return split((above - below) / (2 * h))


def agree(one, other, tolerance):
    """Each array to `tolerance` of its largest entry, and none is zero. The last row of an affine transform is no parameter."""
    for (path, b), a in zip(jax.tree_util.tree_leaves_with_path(other), jax.tree.leaves(one), strict=True):
        name = jax.tree_util.keystr(path)
        a, b = (a[:3], b[:3]) if "world_from_grid" in name else (a, b)
        if "remainder" in name:
            # What rounding leaves of a position is detached, although it moves the position.
            assert not np.any(a), name
            continue
        scale = np.abs(b).max()
        assert scale > 0, name
        np.testing.assert_allclose(a, b, rtol=0, atol=tolerance * scale, err_msg=name)


def check_every_way(p, names, rows=(jax.jacfwd, jax.grad), **options):
    """All ways for the parameters called `names`."""
    fixed, moving = {k: v for k, v in p.items() if k not in names}, {k: p[k] for k in names}
    replay = jax.jit(jax.grad(make_loss(fixed, jvr.Replay(), **options)))(moving)
    agree(replay, central_differences(make_loss(fixed, jvr.Forward(), **options), moving), DIFFERENCES)
    agree(jax.jit(jax.jacfwd(make_loss(fixed, jvr.Forward(), **options)))(moving), replay, ROUNDING)
    for transform in rows:
        agree(jax.jit(transform(make_loss(fixed, jvr.Rows(), **options)))(moving), replay, ROUNDING)


@pytest.mark.slow
def test_every_parameter_at_once(x64):
    p = parameters(TRANSFERS["linear"]())
    check_every_way(p, tuple(p), rows=(jax.grad,))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "rows"),
    [("linear, coloured", (jax.grad,)), ("table", ()), ("Gaussians", ()), ("Gaussians, coloured", (jax.jacfwd, jax.grad))],
)
def test_transfer_functions(kind, rows, x64):
    check_every_way(parameters(TRANSFERS[kind]()), ("transfer", "intercept"), rows=rows)


@pytest.mark.slow
@pytest.mark.parametrize("optical", [jvr.EmissionOnly(), jvr.AbsorptionOnly()], ids=["emission", "absorption"])
def test_optical_models(optical, x64):
    p = parameters(TRANSFERS["table, coloured"]())
    names = ("transfer", "eye") if isinstance(optical, jvr.EmissionOnly) else ("voxels", "eye")
    check_every_way(p, names, rows=(), optical=optical)


@pytest.mark.parametrize(("kind", "parts"), [("linear", 1), ("table, coloured", 2)])
@pytest.mark.slow
def test_pre_integrated_segments(kind, parts, x64):
    check_every_way(parameters(TRANSFERS[kind]()), ("transfer", "voxels", "eye"), rows=(), quadrature=jvr.PreIntegrated(parts))


@pytest.mark.slow
def test_entry_and_exit_through_a_clipping_box(x64):
    p = parameters(TRANSFERS["Gaussians"](), clipped=True, parallel=True)
    check_every_way(p, ("clipping", "eye", "extent"), rows=(), parallel=True)


@pytest.mark.slow
def test_tiles_and_no_jit(x64):
    """Gradients that add up over tiles which do not divide the picture, without `jit`."""
    p = parameters(TRANSFERS["linear"]())
    fixed, moving = {k: v for k, v in p.items() if k != "transfer"}, {"transfer": p["transfer"]}
    whole = jax.jit(jax.grad(make_loss(fixed, jvr.Replay())))(moving)
    agree(jax.grad(make_loss(fixed, jvr.Replay(), tile=7))(moving), whole, ROUNDING)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("transform", "adjoint"),
    [(jax.grad, jvr.Replay()), (jax.jacfwd, jvr.Forward()), (jax.grad, jvr.Rows()), (jax.jacfwd, jvr.Rows())],
    ids=["replay", "forward", "rows, reverse", "rows, forward"],
)
def test_vmapped(transform, adjoint, x64):
    """A batch of gradients is each gradient by itself, by replay. The batch differs in a perturbed and in a fixed array."""
    agree(jax.jit(jax.vmap(gradient_of(transform, adjoint)))(*batch()), alone(), ROUNDING)


def gradient_of(transform, adjoint):
    """By the transfer function, which the camera's place stands beside."""
    p = parameters(TRANSFERS["linear"]())
    fixed = {k: v for k, v in p.items() if k not in ("transfer", "eye")}
    return lambda transfer, eye: transform(make_loss(fixed | {"eye": eye}, adjoint))({"transfer": transfer})


def batch():
    """Two transfer functions, each with a camera of its own."""
    eye = parameters(TRANSFERS["linear"]())["eye"]
    transfers = [linear_transfer(seed=seed) for seed in (1, 5)]
    return jax.tree.map(lambda *x: jnp.stack(x), *transfers), jnp.stack([eye, eye + jnp.array([0.5, 1.0, -0.7])])


@functools.cache
def alone():
    """The gradients of the batch, one by one."""
    gradient = gradient_of(jax.grad, jvr.Replay())
    return jax.jit(lambda x: jax.lax.map(lambda x: gradient(*x), x))(batch())


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "termination"), [("linear", 0.2), ("table, coloured", 0.0), ("linear, coloured", 0.2)])
def test_rows_of_a_table(kind, termination, x64):
    """Without distances, rows of a table come out of one replay with hat functions."""
    p = parameters(TRANSFERS[kind]())
    volume = jvr.Volume(p["voxels"], p["world_from_grid"])
    camera = jvr.PerspectiveCamera.look_at(p["eye"], p["target"], p["up"], p["extent"], WIDTH, HEIGHT)

    def gathered(adjoint):
        settings = jvr.Settings(0.7, skipping=False)

        def of(entries):
            transfer = jax.tree.map(lambda x: x, p["transfer"])
            object.__setattr__(transfer, "rgb", entries["rgb"])
            object.__setattr__(transfer, "sigma_t", entries["sigma_t"])
            rays = marched_rays(jvr.Scene(volume, transfer), camera, settings)
            marched = adjoint.march(MarchOptions(termination, distance=False), *rays)
            return {"radiance": marched.radiance, "tau": marched.tau}

        return of

    entries = {"rgb": p["transfer"].rgb, "sigma_t": 4 * p["transfer"].sigma_t}
    expected = jax.jit(jax.jacfwd(gathered(jvr.Forward())))(entries)
    forward = jax.jit(jax.jacfwd(gathered(jvr.Rows())))(entries)
    reverse = jax.jit(jax.jacrev(gathered(jvr.Rows())))(entries)
    replayed = jax.jit(jax.jacrev(gathered(jvr.Replay())))(entries)
    for other in (forward, reverse, replayed):
        assert jax.tree.structure(other) == jax.tree.structure(expected)
        for a, b in zip(jax.tree.leaves(other), jax.tree.leaves(expected), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-12)
    assert max(np.abs(x).max() for x in jax.tree.leaves(expected)) > 0.1


# What goes through forward mode on its way to a gradient: transposed, batched, or made anew.
FORWARDS_AND_BACK = {
    "jacfwd": jax.jacfwd,
    "linearize": lambda loss: lambda p: jax.linear_transpose(jax.linearize(loss, p)[1], p)(1.0)[0],
    "checkpoint": lambda loss: jax.grad(jax.checkpoint(loss)),
    "checkpoint of vmap": lambda loss: jax.grad(jax.checkpoint(lambda p: jnp.mean(jax.vmap(loss)(each(p))))),
    "checkpoint of vmap, shared": lambda loss: jax.grad(
        jax.checkpoint(lambda p: jnp.mean(jax.vmap(lambda eye: loss(p | {"eye": eye}))(each(p)["eye"])))
    ),
    "scan of checkpoint": lambda loss: jax.grad(
        lambda p: jnp.mean(jax.lax.scan(jax.checkpoint(lambda _, p: (None, loss(p))), None, each(p))[1])
    ),
}


def each(p):
    """A batch of two that are the same."""
    return jax.tree.map(lambda x: jnp.stack([x, x]), p)


@pytest.mark.slow
@pytest.mark.parametrize("way", FORWARDS_AND_BACK)
def test_one_rule_for_both_modes(way, x64):
    loss, moving, gradient = of_several()
    if way == "jacfwd":
        others, moving = moving, {k: moving[k] for k in ("transfer", "background")}
        loss, gradient = lambda p, loss=loss: loss(others | p), {k: gradient[k] for k in moving}
    agree(jax.jit(FORWARDS_AND_BACK[way](loss))(moving), gradient, ROUNDING)


@functools.cache
def of_several():
    """A loss of some kinds of array, where they are, and its gradient there."""
    p = parameters(TRANSFERS["table"]())
    moving = {k: p[k] for k in ("transfer", "background", "voxels", "eye")}
    loss = make_loss({k: v for k, v in p.items() if k not in moving}, jvr.Replay())
    return loss, moving, jax.jit(jax.grad(loss))(moving)


def test_modes_that_a_way_does_not_have_are_refused(x64):
    p = parameters(TRANSFERS["linear"]())
    moving = {"background": p["background"], "transfer": p["transfer"]}
    with pytest.raises(ValueError, match=r"jvr.Forward\(\) has no reverse mode"):
        jax.eval_shape(jax.grad(make_loss(p, jvr.Forward())), moving)


@pytest.mark.slow
def test_memory_of_a_gradient_does_not_grow_with_the_steps():
    """Temporary memory of the compiled gradient: at most 300 bytes a ray and two volumes, whatever the step."""
    size, n = 64, 24
    volume = jvr.Volume(voxels((n, n, n)))
    camera = perspective(volume, size, size)

    def temporary(step, unknown):
        def loss(values, transfer):
            image = jvr.render(jvr.Scene(jvr.Volume(values), transfer), camera, jvr.Settings(step))
            return jnp.sum(image.rgb**2)

        gradient = jax.jit(jax.value_and_grad(loss, argnums=unknown), compiler_options={"xla_backend_optimization_level": 0})
        return gradient.lower(volume.values, linear_transfer()).compile().memory_analysis().temp_size_in_bytes

    of_voxels, of_transfer = temporary(0.5, 0), temporary(0.5, 1)
    assert abs(temporary(0.03, 0) - of_voxels) <= 0.05 * of_voxels
    assert max(of_voxels, of_transfer) <= 300 * size * size + 2 * volume.values.nbytes


@pytest.mark.slow
def test_parts_of_different_precision(x64):
    """With x64 on, a single-precision part of a scene keeps the others' digits and gets a gradient in its own."""
    scene, camera = jvr.Scene(jvr.Volume(voxels(), OBLIQUE), linear_transfer()), perspective(jvr.Volume(voxels(), OBLIQUE))
    image = lambda part, name: jvr.render(eqx.tree_at(lambda s: getattr(s, name), scene, part), camera).rgb
    for name in ("volume", "transfer"):
        part = getattr(scene, name)
        single = jax.tree.map(lambda x: x.astype(jnp.float32), part)
        np.testing.assert_allclose(image(single, name), image(part, name), rtol=1e-5, atol=1e-6)
        gradient = jax.eval_shape(jax.grad(lambda part, name=name: jnp.sum(image(part, name))), single)
        assert [g.dtype for g in jax.tree.leaves(gradient)] == [x.dtype for x in jax.tree.leaves(single)]
