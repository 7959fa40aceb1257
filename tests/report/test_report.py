"""Figures and the page of a fit: they show the arrays they were given, and the page stands on its own."""

import dataclasses
import re
from html.parser import HTMLParser

import jax.numpy as jnp
import numpy as np
import pytest

import jvr
from jvr.fitting.fit import FitResult, FitStats, Iteration
from jvr.pictures import srgb_from_linear
from jvr.report.errors import field_errors
from jvr.report.page import write_fit_page
from jvr.report.page.words import least_determined_in_words, with_error
from jvr.report.plots import comparison_strip, plot_convergence, plot_transfer, png
from jvr.report.plots.pictures import difference_factor

N = 8
RNG = np.random.default_rng(3)
RGB, SIGMA = RNG.uniform(0.1, 0.9, (N, 3)), RNG.uniform(0.1, 0.9, N)
ERRORS = {"transfer.rgb": np.full((N, 3), 0.02), "transfer.sigma_t": np.full(N, 0.05)}


@pytest.fixture
def table():
    return jvr.LutTransfer(RGB, SIGMA, (-1000.0, 400.0))


@pytest.fixture
def history():
    shares = [0.25, 0.25, 1.0, 1.0]
    return tuple(Iteration(i + 1, 10.0**-i, 10.0 + 10 * i, 0.5 * (i + 1), share) for i, share in enumerate(shares))


def panels(figure):
    """The axes with curves, by the first word of their y label."""
    return {axes.get_ylabel().split()[0]: axes for axes in figure.axes if axes.get_ylabel()}


def line(axes, label, which=0):
    return [line for line in axes.get_lines() if line.get_label() == label][which]


def spans(axes):
    """Left and right ends of the shaded stretches."""
    shaded = [patch for patch in axes.patches if hasattr(patch, "get_x") and patch.get_hatch()]
    return [(patch.get_x(), patch.get_x() + patch.get_width()) for patch in shaded]


# --- Which error belongs to which field ------------------------------------------------------------------------------


def test_errors_belong_to_the_field_of_their_name(table):
    rgb, sigma_t = ERRORS.values()
    assert set(field_errors(table, ERRORS | {"volume.values": np.zeros(5)})) == {"rgb", "sigma_t"}
    assert set(field_errors(table, {"sigma_t": sigma_t})) == {"sigma_t"}
    assert field_errors(table, None) == {}
    whole = jvr.LutTransfer(rgb, sigma_t, (0.1, 0.2))
    assert set(field_errors(table, whole)) == {"rgb", "sigma_t", "domain"}
    with pytest.raises(ValueError, match=r"errors of rgb have shape \(8,\), its values \(8, 3\)"):
        field_errors(table, {"transfer.rgb": sigma_t})


def test_a_colour_that_may_be_any_is_undetermined(table):
    rgb, sigma_t = ERRORS.values()
    found = field_errors(table, {"rgb": np.where(np.arange(N)[:, None] == 2, 30.0, rgb), "sigma_t": 30 + sigma_t})
    np.testing.assert_array_equal(np.flatnonzero(np.isinf(found["rgb"]).all(axis=1)), [2])
    assert np.isfinite(found["sigma_t"]).all()


# --- Transfer function -----------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_curves_are_the_arrays(table):
    truth = jvr.LinearTransfer([-900.0, 0.0, 300.0], np.eye(3), [0.0, 1.0, 0.5])
    figure = plot_transfer(table, standard_errors=ERRORS, truth=truth)
    extinction, colour = panels(figure)["extinction"], panels(figure)["colour"]
    fitted, true = line(extinction, "fitted"), line(extinction, "true")
    np.testing.assert_allclose(fitted.get_xdata(), np.linspace(-1000, 400, N), atol=1e-3)
    np.testing.assert_allclose(fitted.get_ydata(), SIGMA, rtol=1e-6)
    np.testing.assert_allclose(true.get_xydata(), [[-900, 0], [0, 1], [300, 0.5]], atol=1e-6)
    for c, name in enumerate(("red", "green", "blue")):
        np.testing.assert_allclose(line(colour, name).get_ydata(), RGB[:, c], rtol=1e-6)
    assert colour.get_xlim() == (-1000, 400)


def test_band_is_one_standard_error(table):
    figure = plot_transfer(table, standard_errors=ERRORS)
    band = panels(figure)["extinction"].collections[0].get_paths()[0].vertices
    heights = [np.ptp(band[np.isclose(band[:, 0], s, atol=1e-3), 1]) for s in np.linspace(-1000, 400, N)]
    np.testing.assert_allclose(heights, 0.1, rtol=1e-5)


def test_strip_shows_the_colours_in_srgb(table):
    strip = plot_transfer(table).axes[0].images[0].get_array()
    np.testing.assert_allclose(np.asarray(strip)[0, [0, -1]], srgb_from_linear(RGB[[0, -1]]), atol=1e-6)


def test_undetermined_entries_are_hollow_and_shaded(table):
    rgb, sigma_t = (error.copy() for error in ERRORS.values())
    sigma_t[[2, 3, 7]], rgb[0, 1] = np.inf, np.inf
    figure = plot_transfer(table, standard_errors={"rgb": rgb, "sigma_t": sigma_t})
    extinction, colour = panels(figure)["extinction"], panels(figure)["colour"]
    hollow = line(extinction, "_undetermined")
    np.testing.assert_allclose(hollow.get_ydata(), SIGMA[[2, 3, 7]], rtol=1e-6)
    assert hollow.get_markerfacecolor() == "white"
    # Entries are 200 apart: shaded as far as halfway to the neighbours.
    np.testing.assert_allclose(spans(extinction), [(-700, -300), (300, 400)], atol=1e-3)
    np.testing.assert_allclose(spans(colour), [(-1000, -900)], atol=1e-3)
    assert len([entry for entry in colour.get_lines() if entry.get_label() == "_undetermined"]) == 1
    assert "not determined by\nthe images" in [
        t.get_text().replace("\nby ", " by\n") for t in extinction.get_legend().get_texts()
    ]
    assert not spans(panels(plot_transfer(table, standard_errors=ERRORS))["extinction"])


def test_an_undetermined_entry_does_not_squeeze_the_rest():
    errors = np.where(np.arange(N) == 1, np.inf, 0.05)
    runaway = jvr.LutTransfer(RGB, np.where(np.arange(N) == 1, 1e6, SIGMA), (0, 1))
    assert panels(plot_transfer(runaway, standard_errors={"sigma_t": errors}))["extinction"].get_ylim()[1] < 2


def test_coloured_extinction_has_three_curves():
    figure = plot_transfer(
        jvr.LinearTransfer(np.arange(N), RGB, RGB[:, ::-1]), standard_errors={"sigma_t": ERRORS["transfer.rgb"]}
    )
    np.testing.assert_allclose(line(panels(figure)["extinction"], "fitted, red").get_ydata(), RGB[:, 2], rtol=1e-6)


def test_gaussians_are_curves_with_bars_at_their_centres():
    gaussians = jvr.GaussianTransfer([0.3, 0.7], [0.05, 0.1], [2.0, 1.0], np.eye(3)[:2])
    figure = plot_transfer(
        gaussians, standard_errors={"height": np.array([0.2, np.inf])}, truth=jvr.LutTransfer(RGB, SIGMA, (0, 1))
    )
    extinction = panels(figure)["extinction"]
    s, sigma_t = line(extinction, "fitted").get_xydata().T
    wanted = 2 * np.exp(-0.5 * ((s - 0.3) / 0.05) ** 2) + np.exp(-0.5 * ((s - 0.7) / 0.1) ** 2)
    np.testing.assert_allclose(sigma_t, wanted, atol=1e-5)
    np.testing.assert_allclose(line(extinction, "_undetermined").get_xydata(), [[0.7, 1.0]], rtol=1e-6)
    bars = extinction.containers[0].lines[2][0].get_segments()
    np.testing.assert_allclose(bars, [[[0.3, 1.8], [0.3, 2.2]]], rtol=1e-6)


def test_emission_has_a_panel_where_there_is_any(table):
    """Of the fitted one, with its errors, and of the true one where that alone glows."""
    glow = np.where(np.arange(N)[:, None] == 1, 1e6, RGB / 10)
    glowing, errors = dataclasses.replace(table, emission=glow), np.full((N, 3), 0.05)
    errors[1] = np.inf
    truth = jvr.LinearTransfer([-900.0, 0.0, 300.0], np.eye(3), [0.0, 1.0, 0.5], emission=np.eye(3)[::-1])
    assert "emission" not in panels(plot_transfer(table))
    shown = panels(plot_transfer(glowing, standard_errors={"emission": errors}, truth=truth))["emission"]
    for c, name in enumerate(("red", "green", "blue")):
        np.testing.assert_allclose(line(shown, name).get_ydata(), glow[:, c], rtol=1e-6)
    np.testing.assert_allclose(line(shown, "true").get_ydata(), [0, 0, 1])
    np.testing.assert_allclose(spans(shown), [(-900, -700)], atol=1e-3)
    assert shown.get_ylim()[1] < 2
    alone = panels(plot_transfer(table, truth=truth))["emission"]
    np.testing.assert_allclose(line(alone, "true").get_ydata(), [0, 0, 1])
    gaussians = jvr.GaussianTransfer([0.5], [0.1], [0.0], np.ones((1, 3)), emission=[[1.0, 2.0, 3.0]])
    assert line(panels(plot_transfer(gaussians))["emission"], "blue").get_ydata().max() == pytest.approx(3, rel=1e-3)


@pytest.mark.parametrize("as_mapping", [True, False])
def test_histogram_is_drawn_behind(table, as_mapping):
    counts, edges = np.array([0, 10, 1000]), np.array([-1000.0, -500, 0, 400])
    histogram = {"counts": counts.tolist(), "edges": edges.tolist()} if as_mapping else (counts, edges)
    figure = plot_transfer(table, histogram=histogram)
    behind = figure.axes[-1]
    np.testing.assert_allclose(behind.patches[0].get_data().values, np.log1p(counts))
    assert behind.get_zorder() < panels(figure)["extinction"].get_zorder()


def test_figures_leave_no_global_state(table):
    """No window, no pyplot: a thousand figures in a notebook or on a server cost nothing once they are gone."""
    import matplotlib.pyplot as plt

    assert png(plot_transfer(table), dpi=50).startswith(b"\x89PNG")
    assert plt.get_fignums() == []


# --- Convergence -----------------------------------------------------------------------------------------------------


def test_convergence_shows_the_history(history):
    figure = plot_convergence(history)
    by_step, by_second = figure.axes[0], figure.axes[1]
    assert by_step.get_yscale() == "log"
    np.testing.assert_allclose(by_step.get_lines()[0].get_xydata(), [(1, 1), (2, 0.1), (3, 0.01), (4, 0.001)])
    np.testing.assert_allclose(by_second.get_lines()[0].get_xdata(), [0.5, 1, 1.5, 2])
    np.testing.assert_allclose(figure.axes[3].get_lines()[0].get_ydata(), [10, 20, 30, 40])
    assert [text.get_text() for text in by_step.texts] == ["25 %", "all rays"]
    faces = by_step.collections[0].get_facecolors()
    np.testing.assert_array_equal(faces[:2, :3], 1)
    assert (faces[2:, :3] < 1).any()


@pytest.mark.parametrize(
    "entries", [[], [(1, 0.0, np.inf, 0.1, 1.0)], [(1, np.nan, np.nan, 0.1, 0.5)], [(1, 1.0, 5.0, 0.1, 1.0)] * 2]
)
def test_odd_histories_can_be_drawn(entries):
    figure = plot_convergence([Iteration(*entry) for entry in entries])
    assert png(figure, dpi=40).startswith(b"\x89PNG")


# --- Pictures --------------------------------------------------------------------------------------------------------


def test_strip_has_target_fitted_and_difference():
    target = RNG.uniform(0, 1, (6, 5, 3))
    fitted = target + 0.004 * np.eye(3)[0]
    figure = comparison_strip([target, target], [fitted, fitted], before=[0 * target] * 2)
    pictures = [axes.images[0] for axes in figure.axes if axes.images]
    assert len(pictures) == 8
    np.testing.assert_allclose(pictures[0].get_array(), srgb_from_linear(target))
    np.testing.assert_allclose(pictures[1].get_array(), 0)
    np.testing.assert_allclose(pictures[3].get_array(), 0.004)
    assert pictures[3].get_clim() == (0, 1 / 200)
    assert figure.axes[3].get_title().endswith(" 200")
    # Row 0 at the top.
    assert pictures[0].origin == "upper"


def test_strip_takes_views_of_other_sizes_and_at_most_six():
    images = [np.zeros((4 + i, 6, 3)) for i in range(20)]
    figure = comparison_strip(images, images)
    labels = [axes.get_ylabel() for axes in figure.axes if axes.get_ylabel()]
    assert len(labels) == 6
    assert labels[0] == "view 1\nidentical"
    assert labels[-1].startswith("view 20")
    with pytest.raises(ValueError, match="20 targets and 19 images"):
        comparison_strip(images, images[1:])
    with pytest.raises(ValueError, match=r"view 1: the target has shape \(4, 6, 3\), the image \(23, 6, 3\)"):
        comparison_strip(images, images[::-1])
    with pytest.raises(ValueError, match="no target images"):
        comparison_strip([], [])


@pytest.mark.parametrize(
    ("high", "factor"), [(0.0, 1), (0.9, 1), (0.3, 2), (0.2, 5), (1e-3, 1000), (1e-9, 10**6), (30.0, 1), (np.nan, 1)]
)
def test_difference_factor(high, factor):
    assert difference_factor([np.full(10, high)]) == factor


# --- The page --------------------------------------------------------------------------------------------------------


class Page(HTMLParser):
    """Elements, references and text of a page; an element closed in the wrong place is an error."""

    VOID = ("meta", "img")

    def __init__(self, text):
        super().__init__()
        self.open, self.tags, self.references, self.words = [], [], [], []
        self.feed(text)
        assert self.open == []
        self.text = " ".join(" ".join(self.words).split())

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.references += [value for name, value in attrs if name in ("src", "href", "srcset", "data", "action")]
        assert not [name for name, _ in attrs if name.startswith("on")]
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] != "style":
            self.words.append(data)


def make_result(transfer, errors, history=(), outcome=jvr.Outcome.CONVERGED, held_out=(), rank=32, worst=()):
    stats = FitStats(12.3, 2_000_000, 1e-4, rank, 900.0, worst, held_out)
    scene = jvr.Scene(volume=jvr.Volume(jnp.zeros((2, 2, 2))), transfer=transfer)
    return FitResult(scene, tuple(history), tuple(errors.values()), tuple(errors), outcome, 1.0, stats)


def make_page(tmp_path, result, **keywords):
    images = [np.full((4, 5, 3), 0.5)]
    given = {"title": "A fit", "targets": images, "fitted": [images[0] + 0.01], "versions": {"jvr": "9.8"}} | keywords
    assert write_fit_page(tmp_path / "page.html", result=result, **given) == tmp_path / "page.html"
    text = (tmp_path / "page.html").read_text(encoding="utf-8")
    return text, Page(text)


@pytest.mark.slow
def test_page_says_what_was_smoothed_and_that_the_model_does_not_explain_the_images(tmp_path, table):
    result = make_result(table, ERRORS)
    plain, _ = make_page(tmp_path, result)
    assert "wrong in the same way" not in plain
    assert "continued smoothly" not in plain
    stats = result.stats._replace(structured=True, design_effect=4.09, smoothed=(("transfer.rgb", 18),))
    told, _ = make_page(tmp_path, result._replace(stats=stats))
    assert "vary 4.09 times as much" in told
    assert "18 of transfer.rgb" in told
    assert "neighbouring residuals are alike" in result._replace(stats=stats)._repr_html_()


WORST = (("transfer.rgb[2, 1]", 0.7), ("transfer.rgb[2, 0]", 0.5), ("transfer.sigma_t[3]", -0.5))


def test_page_stands_on_its_own(tmp_path, table, history):
    result = make_result(table, ERRORS, history, held_out=((41.5, 0.99), (42.5, 0.97)), worst=WORST)
    title = "Skull <b>& 'co'</b>"
    command, config = "jvr fit 'a<b>.toml' && echo", '[volume]\nfile = "<script>alert(1)</script>"'
    text, page = make_page(
        tmp_path, result, title=title, command=command, config_text=config, truth=table, before=[np.zeros((4, 5, 3))]
    )
    assert page.references
    assert all(reference.startswith("data:image/png;base64,") for reference in page.references)
    assert not re.search(r"(https?:)?//|file:|@import|url\(", re.sub(r"base64,[A-Za-z0-9+/=]+", "", text))
    assert not {"script", "link", "iframe", "object"} & set(page.tags)
    assert "Skull &lt;b&gt;&amp; &#x27;co&#x27;&lt;/b&gt;" in text
    for wanted in (title, command, '"<script>alert(1)</script>"', "jvr 9.8"):
        assert wanted in page.text
    assert page.tags.count("img") == 3
    assert [p.name for p in tmp_path.iterdir()] == ["page.html"]


def test_page_says_the_numbers(tmp_path, table, history):
    result = make_result(table, ERRORS, history, held_out=((41.5, 0.99), (42.5, 0.97)), worst=WORST)
    _, page = make_page(tmp_path, result)
    for wanted in (
        "The fit converged, after 4 iterations and 12.3 s.",
        "2 views that took no part in it come out with a PSNR of 42.0 dB and an SSIM of 0.9800.",
        "PSNR, fitted views 40.0 dB",
        "residual 0.01 ",
        "rank 32 of 32",
        "kept samples 2 MB",
        f"{SIGMA[0]:.3f} ± 0.050",
        f"{RGB[7, 2]:.3f} ± 0.020",
        "Raising the red and green of entry 2 (at -600) while lowering the extinction of entry 3 (at -400) hardly changes",
        "the best combination 30 times as sharply as the worst",
    ):
        assert wanted in page.text, wanted


def test_page_names_what_is_undetermined(tmp_path, table):
    rgb, sigma_t = (error.copy() for error in ERRORS.values())
    sigma_t[[2, 3, 7]], rgb[0] = np.inf, np.inf
    result = make_result(table, {"transfer.rgb": rgb, "transfer.sigma_t": sigma_t}, outcome=jvr.Outcome.STEP_LIMIT, rank=29)
    text, page = make_page(tmp_path, result)
    assert "The images do not determine the colour of entry 0; the extinction of entries 2 to 3, 7." in page.text
    assert page.text.count("not determined") - page.text.count("are not determined") == 3 + 3
    assert "3 combinations of the 32 unknowns are not determined by the images at all" in page.text
    assert "reached its limit of iterations" in page.text
    assert text.count('class="swatch hatched"') == 1


@pytest.mark.parametrize(
    ("transfer", "errors", "wanted"),
    [
        (jvr.LinearTransfer(np.arange(N), RGB, SIGMA), {"transfer.positions": np.full(N, 0.5), **ERRORS}, "7.00 ± 0.50"),
        (jvr.LinearTransfer(np.arange(N), RGB, RGB), {"transfer.rgb": ERRORS["transfer.rgb"]}, "extinction, blue"),
        (jvr.GaussianTransfer([0.3], [0.1], [2.0], [[1, 0, 0]]), {"transfer.height": np.array([0.3])}, "2.00 ± 0.30"),
        (
            jvr.GaussianTransfer([0.3], [0.1], [2.0], [[1, 0, 0]]),
            {"transfer.rgb": np.full((1, 3), np.inf)},
            "the colour of Gaussian 0",
        ),
    ],
)
def test_page_of_every_transfer_function(tmp_path, transfer, errors, wanted):
    assert wanted in make_page(tmp_path, make_result(transfer, errors))[1].text


def test_what_is_not_of_the_transfer_function_is_listed(tmp_path, table):
    errors = {"transfer.sigma_t": np.full(N, 0.03), "volume.values": np.full((2, 2, 2), np.inf)}
    _, page = make_page(tmp_path, make_result(table, errors))
    assert f"{SIGMA[1]:.3f} ± 0.030" in page.text
    assert "volume.values not determined" in page.text


def test_errors_of_fields_of_one_shape_are_not_confused(tmp_path):
    table = jvr.LinearTransfer(np.arange(N), RGB, SIGMA)
    errors = {"transfer.sigma_t": np.full(N, 0.03), "transfer.positions": np.full(N, 0.2)}
    _, page = make_page(tmp_path, make_result(table, errors))
    assert f"{SIGMA[1]:.3f} ± 0.030" in page.text
    assert "1.00 ± 0.20" in page.text


def test_long_tables_are_folded(tmp_path):
    long = jvr.LutTransfer(np.full((64, 3), 0.5), np.ones(64), (0, 1))
    assert "<details><summary>All 64" in make_page(tmp_path, make_result(long, {}))[0]


def test_a_failure_keeps_the_old_page(tmp_path, table):
    (tmp_path / "page.html").write_text("old")
    with pytest.raises(ValueError, match="1 targets and 0 images"):
        make_page(tmp_path, make_result(table, ERRORS), fitted=[])
    assert (tmp_path / "page.html").read_text() == "old"
    with pytest.raises(FileNotFoundError, match="create it first"):
        make_page(tmp_path / "none", make_result(table, ERRORS))


@pytest.mark.parametrize(
    ("value", "error", "wanted"),
    [(0.41372, 0.00123, "0.4137 ± 0.0012"), (1234.5, 20.0, "1234 ± 20"), (1.0, 0.0, "1 ± 0"), (1e-12, 1e-13, "1e-12 ± 1e-13")],
)
def test_values_are_rounded_to_their_errors(value, error, wanted):
    assert with_error(value, error) == wanted


def test_worst_combination_in_words():
    gaussians = jvr.GaussianTransfer([5.0], [1.0], [1.0], [[1, 1, 1]])
    assert least_determined_in_words((("transfer.height[0]", 0.9), ("exposure[]", 0.1)), gaussians) == (
        "Changing the height of Gaussian 0 (at 5) and exposure together hardly changes the pictures."
    )


@pytest.mark.slow
def test_page_of_a_real_fit(tmp_path):
    """What `jvr.fit` returns can be written as it is."""
    x = np.linspace(-1, 1, 8)
    volume = jvr.Volume((1 - np.linalg.norm(np.stack(np.meshgrid(x, x, x)), axis=0) / 2).astype(np.float32))
    truth = jvr.LutTransfer(np.linspace(0, 1, 12).reshape(4, 3), [0.0, 0.1, 0.2, 0.3], (0.1, 1))
    cameras = jvr.fibonacci_sphere((3.5,) * 3, 30.0, 2, 25.0, 12, 12)
    images = [jvr.render(jvr.Scene(volume=volume, transfer=truth), camera).rgb for camera in cameras]
    scene = jvr.Scene(volume=volume, transfer=jvr.flat_transfer(volume, 4))
    pick = lambda s: (s.transfer.rgb, s.transfer.sigma_t)
    result = jvr.fit(scene, cameras, images, unknowns=pick, max_steps=3, progress=False)
    fitted = [jvr.render(result.scene, camera).rgb for camera in cameras]
    _, page = make_page(tmp_path, result, targets=images, fitted=fitted, truth=truth)
    assert f"iterations {len(result.history)}" in page.text
    assert "±" in page.text


def test_where_no_unknown_is_seen_the_page_says_so():
    """As after a fit whose light has become negative everywhere and is cut off."""
    transfer = jvr.LutTransfer([[0, 0, 0], [1, 1, 1]], [0, 1], [0, 1])
    words = least_determined_in_words((("material.albedo[]", 0.0), ("environment.coefficients[0, 0]", 0.0)), transfer)
    assert words == "No unknown changes the pictures."
