"""One segment through a piecewise-linear table, the scalar linear between its ends, against quadrature in float64."""

import contextlib
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import gaussian_transfer, linear_transfer, lut_transfer

import jvr
from jvr.model.preintegration import PreIntegratedTable

MODELS = (jvr.EmissionAbsorption(), jvr.EmissionOnly(), jvr.AbsorptionOnly())
NODES, WEIGHTS = np.polynomial.legendre.leggauss(8)
NODES, WEIGHTS = (NODES + 1) / 2, WEIGHTS / 2

KINDS = pytest.mark.parametrize("make", [linear_transfer, lut_transfer], ids=["linear", "table"])
COLOURED = pytest.mark.parametrize("coloured", [False, True], ids=["grey", "coloured"])


def coloured_table(**options):
    return lut_transfer(coloured=True, **options)


# Where derivatives are compiled: each kind of table once, each kind of extinction once.
BOTH = pytest.mark.parametrize("make", [linear_transfer, coloured_table], ids=["linear", "coloured table"])


def quadrature(table, s0, s1, dt, cells=8):
    """Emission with and without attenuation, and optical depth, in three channels: Gauss-Legendre in `cells` parts of each piece
    between two entries, and again inside of each part for the depth in front of each node."""
    positions, rgb = (np.asarray(v, float) for v in (table.positions, table.rgb))
    sigma_t = np.broadcast_to(np.asarray(table.sigma_t, float).reshape(len(positions), -1), rgb.shape)
    inside = [(p - s0) / (s1 - s0) for p in positions if min(s0, s1) < p < max(s0, s1)]
    pieces = np.array([0.0, *sorted(inside), 1.0])
    cuts = np.unique(np.interp(np.arange(cells * (pieces.size - 1) + 1) / cells, np.arange(pieces.size), pieces))
    start, width = cuts[:-1, None], np.diff(cuts)[:, None]
    at = lambda columns, t: np.stack([np.interp(s0 + (s1 - s0) * t, positions, c) for c in columns.T], axis=-1)
    t = start + width * NODES
    sigma, colour = at(sigma_t, t), at(rgb, t)
    cell_depth = dt * width * np.einsum("n,knc->kc", WEIGHTS, sigma)
    front = np.cumsum(cell_depth, axis=0) - cell_depth
    depth_inside = np.einsum("m,knmc->knc", WEIGHTS, at(sigma_t, start[..., None] + (width * NODES)[..., None] * NODES))
    tau = front[:, None] + dt * (width * NODES)[..., None] * depth_inside
    integral = lambda values: dt * np.einsum("n,kn,knc->c", WEIGHTS, width * np.ones_like(t), values)
    return integral(sigma * colour * np.exp(-tau)), integral(sigma * colour), cell_depth.sum(0)


def references(table, s0, s1, dt):
    return (np.array(v) for v in zip(*(quadrature(table, *p) for p in zip(s0, s1, dt, strict=True)), strict=True))


def all_models(table, s0, s1, dt, parts=1):
    """Emission of the two models that emit and optical depth of the two that absorb, a row for each segment."""
    integrated = PreIntegratedTable(table, parts)
    both = [jax.vmap(lambda a, b, d, m=m: integrated.evaluate_segment(m, a, b, d))(s0, s1, dt) for m in MODELS]
    assert both[1][1] == both[2][0] == ()
    column = lambda channels: jnp.stack(jnp.broadcast_arrays(*(channels * (3 // len(channels)))), axis=1)
    return column(both[0][0]), column(both[1][0]), column(both[0][1]), column(both[2][1])


_all_models = jax.jit(all_models, static_argnums=4)


def models(table, ends, parts=1):
    """`all_models`, compiled for one number of segments."""
    return [v[: len(ends[0])] for v in _all_models(table, *filled(ends, 60), parts)]


def segment(table, s0, s1, dt, parts=1):
    """Three components of emission, and one or three of optical depth."""
    emitted, dtau = PreIntegratedTable(table, parts).evaluate_segment(MODELS[0], s0, s1, dt)
    return jnp.stack([*emitted, *dtau])


@jax.jit
@functools.partial(jax.vmap, in_axes=(None, 0, 0, 0))
def _compiled_rows(*arguments):
    values, pull = jax.vjp(segment, *arguments)
    return values, jax.vmap(pull)(jnp.eye(values.size))


def values_and_rows(table, ends):
    """What every segment adds, and the rows of its Jacobian in the table's arrays (by name), `s0`, `s1` and `dt`."""
    values, rows = _compiled_rows(table, *filled(ends, 280))
    by_name = {jax.tree_util.keystr(path): np.asarray(x) for path, x in jax.tree_util.tree_leaves_with_path(rows)}
    return np.asarray(values)[: len(ends[0])], {name: x[: len(ends[0])] for name, x in by_name.items()}


def filled(ends, count):
    """Repeated, so that programs are shared."""
    return [jnp.asarray(np.resize(np.asarray(v), count), float) for v in ends]


def some_segments(seed=0, count=60, thinnest=0.1):
    """Ends inside and outside of 0 ... 1, near and far, in both directions, and lengths; exact in float32."""
    rng = np.random.default_rng(seed)
    s0 = rng.uniform(-0.3, 1.3, count)
    s1 = np.where(np.arange(count) % 3, s0 + 0.1 * rng.normal(size=count), rng.uniform(-0.3, 1.3, count))
    return tuple(np.float64(np.float32(v)) for v in (s0, s1, rng.uniform(thinnest, 0.5, count)))


def in_both_precisions(table, ends, run=values_and_rows):
    """The same in float32 and in float64, of inputs that are exact in float32."""
    results = []
    for double in (False, True):
        with jax.enable_x64(True) if double else contextlib.nullcontext():
            exact = jax.tree.map(lambda v: jnp.asarray(np.float32(v), float), table)
            results.append(jax.tree.map(np.asarray, run(exact, [np.float32(v) for v in ends])))
    return results


def per_row(x):
    """The largest of each row of a Jacobian."""
    return np.abs(x).reshape(len(x), -1).max(1)


@KINDS
@COLOURED
def test_extinction_and_unattenuated_emission_are_exact(make, coloured, x64):
    table, ends = make(coloured=coloured), some_segments()
    _, glow, depth = references(table, *ends)
    _, emitted, dtau, alone = models(table, ends)
    np.testing.assert_allclose(emitted, glow, rtol=1e-12)
    np.testing.assert_allclose(dtau, depth, rtol=1e-12)
    np.testing.assert_array_equal(dtau, alone)


@BOTH
def test_float32_keeps_its_digits(make):
    """A segment of up to five stretches, each rounded a few times."""
    for value, true in zip(*in_both_precisions(make(), some_segments(), models), strict=True):
        np.testing.assert_allclose(value, true, rtol=3e-6)


@pytest.mark.slow
@BOTH
def test_attenuated_emission(make, x64):
    """Segments across all of a table of random colours: 2e-4 at optical depth 0.2, and 4e-6 in four parts. At a fifth of that depth one
    part is near 5e-6, and four are below 1e-6."""
    table, (s0, s1, dt) = make(scale=0.5), some_segments()
    for scale, parts, tolerance in ((1.0, 1, 2e-4), (1.0, 4, 4e-6), (0.2, 1, 6e-6), (0.2, 4, 2e-7)):
        true, *_, depth = references(table, s0, s1, scale * dt)
        assert 0.15 * scale < depth.max() < 0.3 * scale
        emitted, *_ = models(table, (s0, s1, scale * dt), parts)
        assert np.abs(emitted - true).max() < tolerance * true.max()


@pytest.mark.slow
def test_self_attenuation_has_order_four(x64):
    """Optical depth near 1 through entries on smooth curves, coloured."""
    s = np.linspace(0, 1, 33)
    rgb = np.stack([0.5 + 0.4 * np.sin(4 * s), s**2, 0.8 - 0.5 * s], axis=1)
    sigma = 1.2 + np.sin(3 * s)
    table = jvr.LutTransfer(rgb, np.stack([sigma, 0.8 * sigma, sigma[::-1]], axis=1), [0.0, 1.0])
    ends = (0.05, 0.95, 0.8)
    true, _, depth = quadrature(table, *ends)
    assert depth.max() > 1
    counts = np.array([2, 4, 6])
    several = jax.jit(segment, static_argnums=4)
    errors = [np.abs(several(table, *(jnp.array(v) for v in ends), int(p))[:3] - true).max() for p in counts]
    order = -np.polyfit(np.log(counts), np.log(errors), 1)[0]
    assert abs(order - 4) < 0.3, (order, errors)


@BOTH
def test_optical_depth_is_the_same_backwards(make):
    table, (s0, s1, dt) = make(), some_segments()
    there, back = models(table, (s0, s1, dt)), models(table, (s1, s0, dt))
    for a, b in zip(there[1:], back[1:], strict=True):
        np.testing.assert_array_equal(a, b)
    # What is seen of it is not: the front end hides the back end.
    assert np.abs(there[0] - back[0]).max() > 1e-3


def test_a_peak_between_two_samples_is_seen(x64):
    """A peak of width 2e-3 and height 50 on a segment of 100 times its width: its area is what counts."""
    table = jvr.LinearTransfer([0.0, 0.499, 0.5, 0.501], np.eye(3)[[1, 1, 0, 1]], [0.0, 0.0, 50.0, 0.0])
    assert table.evaluate(jnp.array((0.32 + 0.52) / 2)).sigma_t[0] == 0
    ends = ([0.32], [0.52], [3.0])
    true, glow, depth = (v[0] for v in references(table, *ends))
    np.testing.assert_allclose(depth, 50 * 0.001 * 3.0 / 0.2)
    emitted, unattenuated, dtau, _ = (v[0] for v in models(table, ends, 4))
    np.testing.assert_allclose(dtau, depth, rtol=1e-12)
    np.testing.assert_allclose(unattenuated, glow, rtol=1e-12, atol=1e-12)
    # All of it lies in one of the four parts, colours mirrored: what is left is their curvature over optical depth 0.75.
    np.testing.assert_allclose(emitted, true, atol=3e-3)
    assert true.min() == 0
    assert true[:2].min() > 0.1


@pytest.mark.parametrize("segments", [1, 2, 7, 50])
def test_optical_depth_of_a_ray_does_not_depend_on_the_step(segments):
    """A whole ray along which the scalar is linear, over thin peaks."""
    rng = np.random.default_rng(4)
    sigma = np.where(np.arange(64) % 9 == 4, 20 * rng.random(64), 0)
    table = jvr.LutTransfer(rng.random((64, 3)), sigma, [0.0, 1.0])
    ends = np.linspace(-0.1, 1.2, segments + 1)
    *_, dtau = models(table, (ends[:-1], ends[1:], np.full(segments, 1.3 / segments)))
    np.testing.assert_allclose(dtau[:, 0].sum(), sigma.sum() / 63, rtol=2e-6)


@pytest.mark.slow
@pytest.mark.parametrize("make", [linear_transfer, coloured_table], ids=["linear", "coloured table"])
def test_close_ends_keep_every_digit_in_value_and_gradient(make):
    """Ends that are equal, or apart by 1e-7 ... 1: at entries, across them, beside them and outside, in both directions."""
    table = make()
    entries = np.asarray(table.positions)
    places = [*entries, -0.2, 0.123, 0.47, 0.58, 1.5][:9]
    gaps = (0.0, 1e-7, 1e-6, 1e-5, 1e-3, 0.1, 1.0)
    pairs = np.float32([(p - part * gap, p + (1 - part) * gap) for p in places for gap in gaps for part in (0.0, 0.4, 1.1)])
    s0, s1 = np.concatenate([pairs, pairs[:, ::-1]])[:280].T
    (value, rows), (true, true_rows) = in_both_precisions(table, (s0, s1, np.full(len(s0), 0.3)))
    np.testing.assert_allclose(value, true, rtol=3e-6)
    # The derivative jumps at an entry, whose place in an equally spaced table is known up to rounding: that much of a short segment may
    # be on either side. Positions of control points are exact.
    low, high = np.minimum(s0, s1)[:, None] - 1e-6, np.maximum(s0, s1)[:, None] + 1e-6
    at_entry = np.any((entries > low) & (entries < high), axis=1) & (make is coloured_table)
    either_side = np.where(at_entry, 5e-7 / np.maximum(np.abs(s1 - s0), 5e-7), 0)
    ends_there = np.any(np.abs(np.stack([s0, s1])[..., None] - entries) < 1e-6, axis=(0, 2)) & (make is coloured_table)
    either_side[ends_there] = np.inf
    for name, exact in true_rows.items():
        error, size = per_row(rows[name] - exact), per_row(exact)
        assert np.isfinite(error).all(), name
        # Each row to its own size, and to that of all.
        assert np.all(error <= 1e-5 * size + (1e-6 + either_side) * size.max()), f"{name}: {(error / size.max()).max():.1e}"


@BOTH
def test_equal_ends_are_a_segment_of_constant_properties(make):
    table = make()
    s, dt = jnp.array([-0.4, 0.15, 0.3, 0.6, 0.77, 1.2]), jnp.float32(0.4)
    emitted, glow, dtau, _ = models(table, (s, s, np.full(6, dt)))
    for a, *found in zip(s, emitted, glow, dtau, strict=True):
        medium = table.evaluate(a)
        radiance, depth = MODELS[0].evaluate_segment(medium, dt)
        for value, true in zip(
            found, (radiance, MODELS[1].evaluate_segment(medium, dt)[0], depth * (3 // len(depth))), strict=True
        ):
            np.testing.assert_allclose(value, true, rtol=1e-6)


@pytest.mark.slow
@BOTH
@pytest.mark.parametrize("factor", [0.0, 1e-30, 1e-6, 10.0, 1e3, 1e6, 1e8])
def test_extremes_of_extinction(make, factor):
    (value, rows), (true, true_rows) = in_both_precisions(make(scale=factor), some_segments(count=280))
    np.testing.assert_allclose(value, true, rtol=1e-5)
    for name, exact in true_rows.items():
        error, size = per_row(rows[name] - exact), per_row(exact)
        assert np.isfinite(error).all(), name
        # In the entries and the length; and in ends and positions, sums of both signs that leave a hundredth of the largest term.
        allowed = 2e-6 if name.endswith(("rgb", "sigma_t", "[3]")) else 1e-4
        assert np.all(error <= allowed * size + 0.1 * allowed * size.max() + 1e-36), f"{name}: {(error / size.max()).max():.1e}"


def test_gradient_where_nothing_is():
    """The derivative in an extinction that is zero is that of the emission: `dt` times the mean of hat times colour."""
    rgb = np.random.default_rng(5).random((5, 3))
    table = jvr.LutTransfer(rgb, np.zeros((5, 3)), [0.0, 4.0])
    values, rows = values_and_rows(table, [np.array([v]) for v in (0.5, 3.5, 0.8)])
    assert not np.any(values)
    # Simpson's rule is exact for the quadratics between half entries.
    s, weight = np.linspace(0.5, 3.5, 13), np.array([1, 4, 2, 4, 2, 4, 2, 4, 2, 4, 2, 4, 1]) / 36
    hats = np.maximum(0, 1 - np.abs(s[:, None] - np.arange(5)))
    for c in range(3):
        colour = np.interp(s, np.arange(5), rgb[:, c])
        np.testing.assert_allclose(rows["[0].sigma_t"][0, c, :, c], 0.8 * weight @ (hats * colour[:, None]), rtol=1e-5)
        np.testing.assert_allclose(rows["[0].sigma_t"][0, 3 + c, :, c], 0.8 * weight @ hats, rtol=1e-5)


@pytest.mark.parametrize("scale", [1e-3, 1.0, 30.0])
def test_one_colour_opaque_or_not(scale, x64):
    """One colour leaves no error at any optical depth, and the gradient in the extinction keeps `exp(-d)`."""
    colour = np.array([0.9, 0.5, 0.2])
    sigma = scale * np.array([[0.3], [1.0], [0.1], [0.7], [0.2]]) * np.array([1.0, 0.5, 0.1])
    table = jvr.LutTransfer(np.tile(colour, (5, 1)), sigma, [0.0, 1.0])
    values, rows = values_and_rows(table, (np.array([0.05, 0.2, 0.9, 0.3]), np.array([0.95, 0.31, 0.6, 0.3]), np.ones(4)))
    depth = values[:, 3:]
    np.testing.assert_allclose(values[:, :3], colour * -np.expm1(-depth), rtol=1e-13)
    of_emission, of_depth = rows["[0].sigma_t"][:, :3], rows["[0].sigma_t"][:, 3:]
    # Across whole intervals a rounding remains; within neighbouring ones none.
    expected = (colour * np.exp(-depth))[..., None, None] * of_depth
    np.testing.assert_allclose(of_emission[:1], expected[:1], rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(of_emission[1:], expected[1:], rtol=1e-12)


@pytest.mark.parametrize("opaque", [1.0, 1e2, 1e4, 1e10])
def test_colours_stay_between_those_of_the_table(opaque):
    """However coarse one part is for so much self-attenuation."""
    rng = np.random.default_rng(6)
    table = jvr.LutTransfer(rng.random((5, 3)) < 0.5, opaque * rng.random((5, 3)) ** 4, [0.0, 1.0])
    emitted, _, dtau, _ = models(table, some_segments(7))
    colour = np.asarray(emitted) / -np.expm1(-np.asarray(dtau))
    assert colour.min() > -1e-5
    assert colour.max() < 1 + 1e-5
    assert colour.max() - colour.min() > 0.9


@pytest.mark.slow
def test_thin_entries_beside_opaque_ones_keep_their_digits():
    """A difference of prefix sums would have lost them: eleven orders of magnitude between entries of one table."""
    thin = 1e-5 * (1 + np.arange(40) % 3)
    table = jvr.LutTransfer(np.random.default_rng(8).random((40, 3)), np.where(np.arange(40) < 20, 1e6, thin), [0.0, 39.0])
    ends = np.array([[20.5, 38.7], [22.3, 27.9], [38.7, 21.0], [31.0, 32.5], [45.0, 24.5]])
    for value, true in zip(*in_both_precisions(table, (*ends.T, np.ones(5)), models), strict=True):
        assert true.max() < 1e-4
        np.testing.assert_allclose(value, true, rtol=3e-6)


def test_gradient_of_thin_entries_beside_opaque_ones_keeps_its_digits():
    sigma = np.array([1e6, 1e6, 1e-5, 3e-5, 2e-5])[:, None] * np.array([1.0, 0.7, 0.3])
    table = jvr.LutTransfer(np.random.default_rng(8).random((5, 3)), sigma, [0.0, 4.0])
    ends = (np.array([2.25, 4.5]), np.array([4.5, 2.1]), np.ones(2))
    (_, rows), (_, exact) = in_both_precisions(table, ends)
    for name in ("[0].rgb", "[0].sigma_t"):
        # Each entry to its own size: nothing cancels.
        np.testing.assert_allclose(rows[name], exact[name], rtol=3e-6, atol=1e-12, err_msg=name)
        assert np.abs(exact[name]).max() > 1e-6


@pytest.mark.parametrize("scale", [1e-24, 1e24])
def test_units_of_the_scalar(scale):
    """Densities between galaxies in g / cm^3, say: a table of width 1e-24."""
    base, (s0, s1, dt) = linear_transfer(), some_segments(count=280)
    table = jvr.LinearTransfer(np.asarray(base.positions) * scale, base.rgb, base.sigma_t)
    values, rows = values_and_rows(table, (s0 * scale, s1 * scale, dt))
    true, true_rows = values_and_rows(base, (s0, s1, dt))
    np.testing.assert_allclose(values, true, rtol=1e-5)
    for name, power in (("[0].positions", 1), ("[0].sigma_t", 0), ("[0].rgb", 0), ("[1]", 1), ("[2]", 1), ("[3]", 0)):
        exact = true_rows[name]
        np.testing.assert_allclose(rows[name] * scale**power, exact, atol=1e-4 * np.abs(exact).max(), err_msg=name)


@BOTH
def test_far_outside(make):
    """Most of the segment, or all of it, lies beyond the table, where the values at its ends go on."""
    table = make()
    ends = (np.array([-1e30, 1e30, -1e30, -3e6, 1e30, -1e30]), np.array([-1e30, 1e29, 1e30, 0.5, 0.5, -0.5]), np.full(6, 0.3))
    values, rows = values_and_rows(table, ends)
    first, last = np.asarray(table.sigma_t).reshape(len(table.rgb), -1)[[0, -1]]
    expected = 0.3 * np.stack([first, last, (first + last) / 2, first, last, first])
    np.testing.assert_allclose(values[:, 3:], expected, rtol=1e-5)
    assert all(np.isfinite(v).all() for v in rows.values())


def test_a_step_between_neighbouring_floats():
    above = np.nextafter(np.float32(0.5), np.float32(1))
    table = jvr.LinearTransfer([0.1, 0.5, above, 0.9], linear_transfer().rgb, [0.0, 0.0, 1e3, 1e3])
    ends = (np.array([0.5, 0.5, above, 0.2, 0.5]), np.array([above, 0.5, above, 0.8, 0.6]), np.full(5, 0.3))
    (value, rows), (true, _) = in_both_precisions(table, ends)
    np.testing.assert_allclose(value, true, rtol=3e-6)
    np.testing.assert_allclose(value[:, 3], [150, 0, 300, 150, 300], rtol=1e-6)
    assert all(np.isfinite(v).all() for v in rows.values())


def smooth_segments():
    """In one interval, in neighbouring ones, far apart and outside; away from entries, where the derivative in an end jumps."""
    s0, s1 = np.array([0.42, 0.55, 0.2, 0.8, -0.1, 1.1]), np.array([0.51, 0.65, 0.79, 0.22, 0.3, 0.5])
    return s0, s1, np.linspace(0.5, 3.0, 6)


@BOTH
def test_derivatives_are_those_of_central_differences(make, x64):
    arguments = (make(scale=2.0), *(jnp.asarray(v) for v in smooth_segments()))
    _, rows = values_and_rows(arguments[0], arguments[1:])
    names = {jax.tree_util.keystr(path): x for path, x in jax.tree_util.tree_leaves_with_path(arguments)}
    for seed in range(4):
        rng = np.random.default_rng(seed)
        direction = {name: 0.1 * rng.normal(size=x.shape) for name, x in names.items()}
        leaves = jax.tree.unflatten(jax.tree.structure(arguments), list(direction.values()))

        def moved(h, leaves=leaves):
            table, *ends = jax.tree.map(lambda v, dv: v + h * dv, arguments, leaves)
            return values_and_rows(table, ends)[0]

        slope = sum(rows[n].reshape(6, rows["[3]"].shape[1], -1) @ d.reshape(-1) for n, d in direction.items() if n[1] == "0")
        slope += sum(rows[f"[{i}]"] * direction[f"[{i}]"][:, None] for i in (1, 2, 3))
        # Differences of fourth order: h^4 and the rounding of a value near 1 divided by h leave about 1e-11.
        near, far = ((moved(h) - moved(-h)) / (2 * h) for h in (5e-4, 1e-3))
        np.testing.assert_allclose((4 * near - far) / 3, slope, rtol=1e-8, atol=1e-9)


@pytest.mark.slow
@BOTH
def test_forward_mode_is_reverse_mode(make, x64):
    arguments = (make(scale=2.0), *(jnp.asarray(v) for v in smooth_segments()))
    direction = jax.tree.map(lambda v: 0.1 * jnp.cos(3 * jnp.arange(v.size, dtype=v.dtype)).reshape(v.shape), arguments)
    several = jax.vmap(segment, (None, 0, 0, 0))
    _, forward = jax.jit(functools.partial(jax.jvp, several))(arguments, direction)
    _, rows = values_and_rows(arguments[0], arguments[1:])
    reverse = 0.0
    for path, d in jax.tree_util.tree_leaves_with_path(direction):
        row = rows[name := jax.tree_util.keystr(path)]
        reverse += np.tensordot(row, d, axes=d.ndim) if name.startswith("[0]") else row * d[:, None]
    np.testing.assert_allclose(forward, reverse, rtol=1e-11, atol=1e-12)


@pytest.mark.slow
def test_as_users_compile_it():
    """All optimisations on: contracted products and fused loops."""
    table, ends = linear_transfer(scale=5.0), some_segments(count=280)
    inputs = [jnp.asarray(v, jnp.float32) for v in ends]
    loss = lambda *a: jnp.sum(jax.vmap(segment, (None, 0, 0, 0))(*a))
    gradient = jax.jit(jax.grad(loss, argnums=(0, 1, 2, 3)))(table, *inputs)
    with jax.enable_x64(True):
        _, rows = values_and_rows(jax.tree.map(lambda v: jnp.asarray(v, float), table), ends)
    for path, found in jax.tree_util.tree_leaves_with_path(gradient):
        name = jax.tree_util.keystr(path)
        true = rows[name].sum((0, 1) if name.startswith("[0]") else 1)
        np.testing.assert_allclose(found, true, rtol=2e-5, atol=2e-5 * np.abs(true).max(), err_msg=name)


tables = st.sampled_from([2, 5]).flatmap(
    lambda n: st.tuples(
        st.lists(st.floats(1e-3, 2), min_size=n, max_size=n),
        st.lists(st.tuples(*[st.floats(0, 1)] * 3), min_size=n, max_size=n),
        st.lists(st.just(0.0) | st.floats(1e-3, 5), min_size=n, max_size=n),
    )
)


@settings(max_examples=100, deadline=None, derandomize=True)
@given(table=tables, s0=st.floats(-2, 8), s1=st.floats(-2, 8), dt=st.floats(0, 2), equally=st.booleans())
@pytest.mark.slow
def test_any_table(table, s0, s1, dt, equally):
    gaps, rgb, sigma_t = (np.array(v) for v in table)
    with jax.enable_x64(True):
        spaced = lambda: jvr.LinearTransfer(np.cumsum(gaps), rgb, sigma_t)
        table = jvr.LutTransfer(rgb, sigma_t, [-0.5, 4.0]) if equally else spaced()
        emitted, glow, dtau, _ = (np.asarray(v[0]) for v in models(table, ([s0], [s1], [dt])))
        true, true_glow, depth = quadrature(table, s0, s1 if s1 != s0 else np.nextafter(s0, np.inf), dt)
    np.testing.assert_allclose(dtau, depth, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(glow, true_glow, rtol=1e-9, atol=1e-12)
    # One part: whatever the colours between 0 and 1, the error is at most the integral of the difference of the kernels.
    tau, y = depth * np.linspace(0, 1, 2001)[:, None], depth / 2
    kernel = -np.expm1(-depth) / np.maximum(depth, 1e-300) * (1 - (tau - y) * (1 + y**4) ** -0.25)
    worst = np.trapezoid(np.abs(np.exp(-tau) - kernel), tau, axis=0)
    assert np.all(np.abs(emitted - true) <= worst * (1 + 1e-6) + 1e-9)


def test_what_cannot_be_prepared():
    with pytest.raises(TypeError, match="LutTransfer"):
        PreIntegratedTable(gaussian_transfer())
    with pytest.raises(ValueError, match="positive whole number"):
        PreIntegratedTable(lut_transfer(), 0)
