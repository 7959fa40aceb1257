"""Experiments of light: what they set up is what they say, and each runs from its command."""

import json
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jvr
from experiments import (
    contact_sheet,
    contact_subjects,
    convergence,
    first_hit_rates,
    occlusion_accuracy,
    other_renderers,
    phase_recovery,
    piecewise_shadows,
    pose_recovery,
    relight,
    shadowed_fit,
    surface_fit,
    tomography,
)
from jvr.io.config import build_fit, build_scene, read_config
from jvr.model.clipping import parts_of_clipping


@pytest.fixture
def embedded(monkeypatch, tmp_path):
    """No scans are found."""
    for module in (contact_subjects, shadowed_fit):
        monkeypatch.setattr(module, "DATA", tmp_path)


def ran(module, monkeypatch, tmp_path, *arguments):
    """What the quick experiment writes: its JSON, and the size of its figure."""
    numbers, picture = tmp_path / "numbers.json", tmp_path / "picture.png"
    monkeypatch.setattr(sys, "argv", ["experiment", "--quick", "--json", str(numbers), "--figure", str(picture), *arguments])
    module.main()
    return json.loads(numbers.read_text()), picture.stat().st_size


@pytest.mark.slow
def test_the_contact_sheet_shows_every_effect_once(embedded):
    (of,) = contact_sheet.subjects(8)
    scenes = {title: scene for group in contact_sheet.SHEETS["light"] for title, scene in group(of).items()}
    assert len(scenes) == 5 * contact_sheet.COLUMNS
    shown = {type(part) for s in scenes.values() for part in (s.shading, s.shadows, s.normals, s.transfer, *s.lights)}
    shown |= {type(s.scattering.phase) for s in scenes.values() if s.scattering is not None}
    wanted = "Lambert Phong BlinnPhong ShadowRays ShadowVolume ShadowMap OpacityShadowMap DeepShadowMap AnalyticGradient "
    wanted += "ForwardDifferences CentralDifferences SobelDifferences PrecomputedGradient GradientOpacity GradientTransfer "
    wanted += "DirectionalLight PointLight SpotLight HeadLight AmbientLight Isotropic HenyeyGreenstein Rayleigh"
    assert {getattr(jvr, name) for name in wanted.split()} <= shown
    assert any(s.scattering is not None and s.scattering.needs_gradient for s in scenes.values())


@pytest.mark.slow
def test_the_sheet_of_surfaces_shows_every_effect_once(embedded):
    (of,) = contact_sheet.subjects(8)
    scenes = {title: scene for group in contact_sheet.SHEETS["surfaces"] for title, scene in group(of).items()}
    assert len(scenes) == 3 * contact_sheet.COLUMNS
    parts = [(s.surfaces, s.specular, s.occlusion, s.geometry, s.background, s.shadows, s.shading) for s in scenes.values()]
    shown = {type(part) for some in parts for part in some}
    shown |= {type(part) for s in scenes.values() for part in parts_of_clipping(s.clipping)}
    wanted = "Isosurfaces Specular LocalOcclusion HistogramOcclusion SurfaceOcclusion Mesh DepthImage EnvironmentMap "
    wanted += "PiecewiseShadows InScattering PhenomenologicalBSDF AnisotropicGGX ClippingPlane"
    assert {getattr(jvr, name) for name in wanted.split()} <= shown
    assert any(s.transfer.emission is not None for s in scenes.values() if not s.transfer.is_clear)
    assert {s.surfaces.is_opaque for s in scenes.values() if s.surfaces is not None} == {True, False}


@pytest.mark.slow
def test_subjects_of_the_contact_sheet_look_as_their_configurations(embedded):
    (of,) = contact_sheet.subjects(8)
    given = build_scene(read_config(contact_subjects.CONFIGS / "lit.toml"))
    old, new = (scene.volume.sample for scene in (given, of.scene))
    x = jnp.asarray([[3.0, 10.0, -5.0], [-20.0, 1.0, 12.0]])
    at = lambda scene, sample: jax.vmap(lambda x: sample(scene.volume.grid_from_world((x[0], x[1], x[2]))))(x)
    # The volume is resampled: about the curvature of a voxel.
    np.testing.assert_allclose(at(of.scene, new), at(given, old), atol=0.05)
    for s in (0.2, 0.5, 0.8):
        found, wanted = (scene.transfer.evaluate(jnp.asarray(s)) for scene in (of.scene, given))
        np.testing.assert_allclose(found.sigma_t, wanted.sigma_t, atol=0.02)
        np.testing.assert_allclose(found.rgb, wanted.rgb, atol=0.02)


def test_a_light_turns_about_the_vertical():
    scene = build_scene(read_config(phase_recovery.CONFIG))
    x, y, z = np.asarray(scene.lights[0].direction)
    np.testing.assert_allclose(phase_recovery.turned(scene, 90.0).lights[0].direction, [-y, x, z], atol=1e-6)


@pytest.mark.slow
def test_true_values_are_those_of_the_configuration():
    config = read_config(phase_recovery.CONFIG, phase_recovery.LOBES)
    np.testing.assert_allclose(phase_recovery.true_values(config), [0.7, -0.4, 0.75, 0.8])
    directed = phase_recovery.true_values(read_config(phase_recovery.CONFIG, phase_recovery.DIRECTION))
    np.testing.assert_allclose(directed[2:], np.array([0.8, 0.6, -0.4]) / np.sqrt(1.16), rtol=1e-6)


def test_errors_of_a_table_are_relative_to_the_true_one():
    truth = jvr.LutTransfer(np.full((4, 3), 0.5), [0.0, 1.0, 2.0, 2.0], (0.0, 1.0))
    wrong = jvr.LutTransfer(np.full((4, 3), 0.6), [0.3, 1.0, 2.0, 2.0], (0.0, 1.0))
    assert shadowed_fit.table_errors(truth, truth) == {"extinction": 0, "largest_extinction": 0, "colour": 0}
    found = shadowed_fit.table_errors(wrong, truth)
    assert found == pytest.approx({"extinction": 0.1, "largest_extinction": 0.15, "colour": 0.1}, rel=1e-5)


def test_the_head_and_its_maps_have_their_up_and_front_where_the_world_has_them(embedded):
    """Axes are a rotation, and a map's light from above and from its centre comes from there in the world."""
    of = relight.study(quick=True)
    np.testing.assert_allclose(np.linalg.det(of.axes), 1.0, rtol=1e-6)
    bright = np.zeros((16, 32, 3))
    bright[:2] = 1.0  # above
    above = of._replace(maps=(bright, bright)).light(0, 2).radiance(np.array([[0.0, 0, 1], [0, 0, -1]]))
    assert above[0, 0] > above[1, 0] + 0.1
    bright = np.zeros((16, 32, 3))
    bright[6:10, 14:18] = 1.0  # the centre: the front, where the first camera is
    front = of._replace(maps=(bright, bright)).light(0, 2).radiance(np.array([[0.0, -1, 0], [0, 1, 0]]))
    assert front[0, 0] > front[1, 0] + 0.05


@pytest.mark.parametrize("name", ["shadowed_fit.toml", "real/shadowed_fit.toml"])
@pytest.mark.slow
def test_configurations_of_the_shadowed_fit_describe_the_same_experiment(name, request, monkeypatch):
    if name.startswith("real"):
        monkeypatch.setenv("JVR_DATA", str(request.getfixturevalue("data")))
    config = read_config(shadowed_fit.CONFIGS / name)
    several = isinstance(config.data["camera"], list)
    places = [f"camera.{i}" for i in range(len(config.data["camera"]))] if several else ["camera"]
    small = [f"{place}.{side}=4" for place in places for side in ("width", "height")]
    job = build_fit(read_config(shadowed_fit.CONFIGS / name, [*small, "settings.step=8.0"]))
    assert isinstance(job.scene.shadows, jvr.ShadowVolume)
    assert job.scene.transfer.sigma_t.shape == job.truth.sigma_t.shape == (16,)
    assert job.held_out is not None


@pytest.mark.parametrize("of", contact_sheet.SHEETS)
@pytest.mark.slow
def test_the_contact_sheet_runs(of, embedded, monkeypatch, tmp_path):
    result, size = ran(contact_sheet, monkeypatch, tmp_path, "--of", of)
    assert size > 10_000
    assert all(np.isfinite(row["largest"]) and row["mean"] > 0.005 for row in result["pictures"])


@pytest.mark.slow
def test_the_recovery_of_phase_functions_runs(monkeypatch, tmp_path):
    result, size = ran(phase_recovery, monkeypatch, tmp_path)
    assert size > 10_000
    determined = [row for row in result["table"] if "moving" in row["run"]]
    # Three standard errors for each of six numbers, with fixed noise.
    assert all(row["errors_from_truth"] < 3 for row in determined)
    assert all(row["standard_error"] is None for row in result["table"] if row not in determined)


@pytest.mark.slow
def test_the_fit_with_and_without_shadows_runs(embedded, monkeypatch, tmp_path):
    result, size = ran(shadowed_fit, monkeypatch, tmp_path)
    assert size > 10_000
    scores = {row["model"]: row for row in result["table"]}
    assert scores["with shadows"]["fitted_psnr"] > scores["without shadows"]["fitted_psnr"]


@pytest.mark.slow
def test_relighting_runs(monkeypatch, tmp_path):
    result, size = ran(relight, monkeypatch, tmp_path)
    assert size > 10_000
    rows = {row["model"]: row for row in result["table"]}
    exact, without = rows["exact product"], rows["no transfer"]
    assert exact["determined"] == 12
    assert exact["coefficients"] < without["coefficients"]
    assert all(exact[key]["psnr"] > without[key]["psnr"] for key in ("held_out", "relit"))


@pytest.mark.slow
def test_rates_of_the_first_hit_run(monkeypatch, tmp_path):
    result, size = ran(first_hit_rates, monkeypatch, tmp_path)
    assert size > 10_000
    rows = {row["choice"]: row for row in result["rows"]}
    # What is met is met to the tolerance, float32 included, at any rate; what is missed depends on it.
    assert all(row["error_largest"] < 1.5e-4 for row in rows.values())
    coarse, fine = rows["one rate, every 2 voxels"], rows["one rate, every 0.25 voxels"]
    assert coarse["missed"] > 0.005
    sure, guaranteed = rows["two rates, every 2 and 0.25 voxels, band 1"], rows["guaranteed, every 1 voxels"]
    assert sure["missed"] == fine["missed"]
    assert guaranteed["missed"] == 0
    assert coarse["samples"] < guaranteed["samples"] < fine["samples"]


@pytest.mark.slow
def test_the_accuracy_of_occlusion_runs(monkeypatch, tmp_path):
    result, size = ran(occlusion_accuracy, monkeypatch, tmp_path)
    assert size > 10_000
    for subject in result["subjects"]:
        rows = {(row["method"], row["knob"]): row for row in subject["rows"]}
        for method in ("local", "in-scattering"):
            default = rows[method, "default"]
            for where in ("seen", "matter"):
                assert default[f"rmse_{where}"] < 0.5 * default[f"without_{where}"]
            # More directions are nearer to all of them.
            assert rows[method, "rays 8"]["rmse_matter"] > default["rmse_matter"]
        surface = rows["surface", "default"]
        assert surface["rmse_seen"] < 0.5 * surface["without_seen"]


@pytest.mark.slow
def test_the_fit_of_a_surface_runs(monkeypatch, tmp_path):
    report, size = ran(surface_fit, monkeypatch, tmp_path)
    assert size > 10_000
    # Two renderers that share nothing, but for pixels where single and double precision meet different things.
    assert report["renderers"]["rms_inside"] < 1e-5
    for row in report["derivatives"].values():
        # Inside, what the surface's curve adds over half a voxel.
        assert row["missing_inside"] < 0.3 * row["missing_at_silhouettes"]
        # What no ray's derivative knows is at silhouettes, and is nearly all of the difference that there is.
        assert row["missing_at_silhouettes"] > 0.5
        assert row["difference_at_silhouettes"] > 0.9
    # From pixels whose derivatives are whole the isovalue is found.
    for fit in report["fits"]:
        if not fit["silhouettes"]:
            assert abs(fit["isovalue"]) < 3 * fit["isovalue_error"]
            assert abs(fit["isovalue"]) < 0.25 * surface_fit.OFF


@pytest.mark.slow
def test_the_table_of_piecewise_shadows_runs(monkeypatch, tmp_path):
    result, size = ran(piecewise_shadows, monkeypatch, tmp_path)
    assert size > 10_000
    (subject,) = result["subjects"].values()
    rows = {(row["piece"], row["resolution"]): row["rmse"] for row in subject["rows"]}
    # An exact piece is better than none, and that than no shadows.
    assert rows[4, 0.5] < rows[0, 0.5] < subject["without"]["rmse"]


@pytest.mark.slow
def test_convergence_runs_beside_scipy(monkeypatch, tmp_path):
    report, size = ran(convergence, monkeypatch, tmp_path)
    assert size > 1000
    assert set(report) == {"random", "noise"}
    for found in report.values():
        assert found["at_bottom"] == 1
        assert found["falsely_converged"] == 0
        assert len(found["jvr"]) == 2
        # The compression keeps the length of the residual: SciPy's error is that of its table.
        assert found["scipy"][0]["mse"] >= 0.99 * found["best"]


@pytest.mark.slow
def test_pictures_of_other_renderers_are_explained(monkeypatch, tmp_path):
    """The quick phantom: jvr draws the known function as VTK does, and a fit explains a view that was kept aside as well."""
    pytest.importorskip("vtk")
    numbers = tmp_path / "numbers.json"
    monkeypatch.setattr(sys, "argv", ["experiment", "--quick", "--json", str(numbers), "--only", "GPU"])
    other_renderers.main()
    found = json.loads(numbers.read_text())
    assert set(found) == {"VTK GPU, phantom", "VTK GPU, phantom, shaded"}
    plain, shaded = found.values()
    # 20 voxels a side leave surfaces of a pixel: 40 dB, where scans in larger pictures come to more than 50.
    assert plain["known_psnr"] > 39
    assert plain["held_out_psnr"] > plain["known_psnr"] - 1.5
    assert shaded["held_out_psnr"] > 35
    assert plain["opacity_rmse"] < 0.06
    assert all(row["outcome"] == "CONVERGED" for row in found.values())


@pytest.mark.slow
def test_poses_are_recovered(monkeypatch, tmp_path):
    result, size = ran(pose_recovery, monkeypatch, tmp_path)
    assert size > 10_000
    # The embedded phantom in pictures of 24^2, from two starts.
    for kind in result["kinds"].values():
        runs = kind["runs"].values()
        assert max(run["success"] for run in runs) > 0
        assert min(run["median_degrees"] for run in runs if run["success"]) < 0.5
        assert all(np.isfinite(row["end"]).all() for run in runs for row in run["rows"])


@pytest.mark.slow
def test_voxels_are_found_beside_other_methods(monkeypatch, tmp_path):
    result, size = ran(tomography, monkeypatch, tmp_path)
    assert size > 10_000
    found = {(row["method"], row["views"]): row["voxels"] for row in result["absorption"]}
    bounded = found["TV, L-BFGS-B", 8]
    assert bounded > found["no prior", 8]
    assert bounded > found["FBP", 8]
    assert all(found[method, 8] > found[method, 4] for method in ("FBP", "SART"))
    assert {row["method"] for row in result["colours"]} == {"no prior", "Tikhonov", "TV", "TV, coarse to fine"}
    assert all(row["held_out"] > 15 for row in result["colours"])
