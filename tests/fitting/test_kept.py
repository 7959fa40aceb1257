"""What is computed once and kept with a scene: after anything was replaced, pictures and gradients are those of a scene made anew."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import perspective

import jvr
from jvr.model.kept import is_made_of, note_sources

SETTINGS = jvr.Settings(0.7)
KINDS = ["bricked", "graded", "packed"]


def voxels(kind: str, seed: int, shape=(10, 9, 11)) -> np.ndarray:
    """A blob in a void, elsewhere for another seed."""
    grid = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), -1)
    middle = (np.asarray(shape) - 1) * ([0.3, 0.3, 0.3] if seed == 0 else [0.7, 0.65, 0.7])
    blob = np.clip(3.5 - np.linalg.norm(grid - middle, axis=-1), 0, 1) * (1 + 0.3 * np.sin(grid.sum(-1)))
    return np.round(150 * blob).astype(np.uint8) if kind == "packed" else blob.astype(np.float32)


def keep(kind: str, volume: jvr.Volume) -> jvr.Volume:
    return getattr(volume, kind)()


def scene_of(kind: str, volume: jvr.Volume) -> jvr.Scene:
    return jvr.Scene(
        volume,
        jvr.LinearTransfer([0.2, 0.5, 1.3], np.array([[0.9, 0.5, 0.3], [0.3, 0.8, 0.5], [0.9, 0.9, 0.4]]), [0.0, 0.3, 0.9]),
        background=(0.1, 0.2, 0.3),
        lights=[jvr.DirectionalLight((0.3, -0.5, -0.8), 2.0)],
        shading=jvr.Lambert(ambient=0.2) if kind == "graded" else None,
        normals=jvr.PrecomputedGradient() if kind == "graded" else jvr.AnalyticGradient(),
    )


def plain(kind: str, seed: int = 0) -> jvr.Volume:
    return jvr.Volume(voxels(kind, seed), slope=0.01 if kind == "packed" else 1.0)


def without(volume: jvr.Volume) -> jvr.Volume:
    """The volume without what it keeps: made anew."""
    made = jvr.Volume(volume.values, volume.world_from_grid, slope=volume.slope, intercept=volume.intercept)
    return eqx.tree_at(lambda v: v.interpolation, made, volume.interpolation)


def replacements(kind: str):
    """A kept volume and what it becomes, by every part that can be replaced."""
    other = plain(kind, 1)
    turned = jnp.diag(jnp.array([1.2, 1.0, 0.9, 1.0]))
    yield "values by tree_at", lambda v: eqx.tree_at(lambda v: v.values, v, other.values)
    yield "values by map", lambda v: jax.tree.map(lambda x: other.values if x is v.values else x, v)
    yield "slope", lambda v: eqx.tree_at(lambda v: v.slope, v, 1.6 * v.slope)
    yield "intercept", lambda v: eqx.tree_at(lambda v: v.intercept, v, v.intercept + 0.25)
    yield "world_from_grid", lambda v: eqx.tree_at(lambda v: v.world_from_grid, v, turned)
    yield "another shape", lambda v: eqx.tree_at(lambda v: v.values, v, jnp.asarray(voxels(kind, 1, (8, 12, 9))))
    yield "copied", lambda v: jax.tree.map(jnp.array, v)
    if kind == "packed":
        yield "another type", lambda v: eqx.tree_at(lambda v: v.values, v, other.values.astype(jnp.float32) + 0.5)


as_argument = jax.jit(lambda scene, camera: jvr.render(scene, camera, SETTINGS))


def close(found: jvr.Rendering, expected: jvr.Rendering, name: str):
    # Programs that round differently; what is stale is off by 0.02 and more.
    for part in ("rgb", "alpha"):
        np.testing.assert_allclose(getattr(found, part), getattr(expected, part), rtol=0, atol=1e-5, err_msg=name)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["bricked", "graded", "packed"])
def test_pictures_after_a_replacement_are_those_of_a_scene_made_anew(kind):
    """With concrete arrays, and where the scene is an argument of a compiled function."""
    check_pictures(kind, lambda name: "another" not in name)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_pictures_after_a_replacement_by_another_shape_or_type(kind):
    check_pictures(kind, lambda name: "another" in name)


def check_pictures(kind, chosen):
    before = keep(kind, plain(kind))
    camera = perspective(without(before), 7, 6)
    stale = as_argument(scene_of(kind, without(before)), camera)
    for name, replace in replacements(kind):
        if not chosen(name):
            continue
        volume = replace(before)
        expected = as_argument(scene_of(kind, without(volume)), camera)
        assert name == "copied" or np.abs(expected.rgb - stale.rgb).max() > 0.02
        close(jvr.render(scene_of(kind, volume), camera, SETTINGS), expected, name)
        close(as_argument(scene_of(kind, volume), camera), expected, name)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["bricked", "packed", "graded"])
def test_pictures_where_voxels_are_the_only_argument(kind):
    """All else is closed over, what was kept of other voxels as well."""
    before, after = keep(kind, plain(kind)), plain(kind, 1)
    camera = perspective(before, 7, 6)
    of_voxels = lambda v: jvr.render(scene_of(kind, eqx.tree_at(lambda v: v.values, before, v)), camera, SETTINGS)
    anew = without(eqx.tree_at(lambda v: v.values, before, after.values))
    close(jax.jit(of_voxels)(after.values), as_argument(scene_of(kind, anew), camera), kind)


@pytest.mark.slow
@pytest.mark.parametrize("way", ["compiled", "concrete"])
@pytest.mark.parametrize("kind", ["bricked", "graded"])
def test_gradients_in_voxels_know_what_is_kept_of_them(kind, way):
    """The same with what is kept and without, at the voxels that it was made of and at others; by both modes."""
    camera = perspective(plain(kind), 6, 5)
    weights = jnp.asarray(np.random.default_rng(0).normal(size=(5, 6, 3)), jnp.float32)

    def loss(values, volume):
        scene = scene_of(kind, eqx.tree_at(lambda v: v.values, volume, values))
        return jnp.sum(weights * jvr.render(scene, camera, SETTINGS).rgb)

    gradient = jax.grad(loss)
    if way == "compiled":
        gradient = jax.jit(gradient)
    for seed in (0, 1):
        values = jnp.asarray(voxels(kind, seed))
        kept, anew = gradient(values, keep(kind, plain(kind))), gradient(values, plain(kind))
        np.testing.assert_allclose(kept, anew, rtol=1e-4, atol=1e-5 * np.abs(anew).max())
        assert np.abs(anew).max() > 0


@pytest.mark.slow
def test_forward_derivatives_know_what_is_kept_of_the_voxels():
    camera = perspective(plain("graded"), 5, 4)
    change = jnp.asarray(np.random.default_rng(0).normal(size=(10, 9, 11)), jnp.float32)

    def picture(values, volume):
        scene = scene_of("graded", eqx.tree_at(lambda v: v.values, volume, values))
        return jvr.render(scene, camera, jvr.Settings(0.7, adjoint=jvr.Forward())).rgb

    slope = jax.jit(lambda values, volume: jax.jvp(lambda v: picture(v, volume), (values,), (change,))[1])
    values = jnp.asarray(voxels("graded", 1))
    kept, anew = slope(values, plain("graded").graded()), slope(values, plain("graded"))
    np.testing.assert_allclose(kept, anew, rtol=1e-4, atol=1e-5 * np.abs(anew).max())


@pytest.mark.slow
def test_a_fit_of_voxels_leaves_what_was_kept_of_the_start():
    """What is negligible is left out by the bricks of the voxels of each step."""
    target, start = plain("bricked", 1), plain("bricked", 0)
    settings = jvr.Settings(0.7, negligible=1e-3)
    camera = perspective(target, 8, 7)
    images = [jvr.render(scene_of("bricked", target), camera).rgb]
    import optimistix as optx

    def fitted(volume):
        return jvr.fit(
            scene_of("bricked", volume),
            [camera],
            images,
            unknowns=lambda s: s.volume.values,
            settings=settings,
            solver=optx.LBFGS(rtol=1e-6, atol=1e-8),
            max_steps=6,
            progress=False,
        )

    kept, anew = fitted(start.bricked()), fitted(start)
    assert kept.history[-1].loss == pytest.approx(anew.history[-1].loss, rel=1e-3)
    assert anew.history[-1].loss < 0.8 * anew.history[0].loss


def test_arrays_at_hand_are_kept_as_they_are():
    """Nothing is made anew where nothing was replaced, also after parts that it does not depend on were."""
    volume = plain("bricked").bricked(2).graded()
    assert volume.current() is volume
    moved = eqx.tree_at(lambda v: v.world_from_grid, volume, 2 * volume.world_from_grid)
    assert moved.current() is moved
    replaced = eqx.tree_at(lambda v: v.values, volume, volume.values + 1).current()
    assert replaced.bricks.size == 2
    np.testing.assert_array_equal(replaced.bricks.lower, volume.bricks.lower + 1)
    packed = plain("packed").packed().bricked()
    assert packed.current() is packed


def test_packing_keeps_what_was_kept_before():
    """Voxels are rounded to 8 bits: bounds and gradients are those of the rounded ones."""
    before = plain("bricked").bricked(2).graded().packed()
    assert before.current() is before
    after = plain("bricked").packed().bricked(2).graded()
    for a, b in zip(jax.tree.leaves(before), jax.tree.leaves(after), strict=True):
        np.testing.assert_array_equal(a, b)


def test_sources_are_told_by_identity_and_not_kept_alive():
    """Equal numbers are not the same array; and an array that has gone is not mistaken for one that comes to lie in its place."""
    source, derived = jnp.ones(3), jnp.zeros(3)
    note_sources(derived, source)
    assert is_made_of(derived, source)
    assert not is_made_of(derived, jnp.ones(3))
    assert not is_made_of(derived, source, source)
    assert not is_made_of(jnp.zeros(3), source)
    import gc
    import weakref

    gone = weakref.ref(source)
    del source
    gc.collect()
    assert gone() is None
