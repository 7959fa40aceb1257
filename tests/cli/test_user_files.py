"""The user's files: what is read is never written over, what is written is whole, and every end is said in one line."""

import errno
import json
import os
import signal
import stat
import subprocess
import sys
import time
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import optax
import optimistix as optx
import pytest
from fits import CAMERAS, IMAGES, TRUTH, VOLUME, both, fit
from PIL import Image
from test_cli import FIT, snapshot

import jvr
from jvr import cli
from jvr.atomic import replacing
from jvr.cli.folder import alone_in
from jvr.cli.inputs import BadInput, check_inputs_stay, name_of
from jvr.fitting import checkpoint
from jvr.rendering.measure import similarity

JVR = [sys.executable, "-c", "from jvr.cli import main; main()"]


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("JVR_CACHE", "0")
    monkeypatch.setenv("PYTHONPATH", str(Path(jvr.__file__).parents[1]))
    (tmp_path / "fit.toml").write_text(FIT)


def refused(line, hint, capfd):
    """The command changes nothing and says why in one line."""
    before = snapshot(Path())
    assert cli.run(line.split()) == 2
    said = capfd.readouterr().err
    assert said.count("\n") == 1
    assert hint in said
    assert snapshot(Path()) == before


# --- Names and inputs ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("given", "name"),
    [
        ("scan.v2.nii.gz", "scan.v2"),
        ("my.volume.tif", "my.volume"),
        ("a/head.nrrd", "head"),
        ("fit.v1.toml", "fit.v1"),
        ("HEAD.NII.GZ", "HEAD"),
        ("counts.u8", "counts.u8"),
        (".nrrd", ".nrrd"),
    ],
)
def test_default_names_keep_all_but_the_known_ending(given, name):
    assert name_of(Path(given)) == name


def test_a_folder_keeps_its_whole_name(tmp_path):
    (tmp_path / "series.2").mkdir()
    assert name_of(tmp_path / "series.2") == "series.2"
    assert name_of(Path()) == tmp_path.name


def test_an_output_never_changes_what_is_read(tmp_path, capfd):
    refused("tune fit.toml -o fit.toml --error 1e-3", "would change fit.toml, which is read", capfd)
    (tmp_path / "slices").mkdir()
    (tmp_path / "slices" / "000.png").touch()
    (tmp_path / "link.toml").symlink_to("fit.toml")
    with pytest.raises(BadInput, match="slices, which is read"):
        check_inputs_stay(Path("slices/new.png"), [Path("slices")])
    with pytest.raises(BadInput, match=r"fit\.toml, which is read"):
        check_inputs_stay(Path("link.toml"), [Path("fit.toml")])
    check_inputs_stay(Path("slices/new.exr"), [Path("slices"), Path("fit.toml")])


# --- The folder of a fit ---------------------------------------------------------------------------------------------


def test_results_of_another_fit_stay(tmp_path, capfd):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "fitted_00.png").touch()
    refused("fit fit.toml -o out", "holds fitted_00.png", capfd)
    (tmp_path / "out" / "checkpoint.npz").touch()
    refused("fit fit.toml -o out", "holds an unfinished fit; go on with --resume, or start anew with --force", capfd)
    (tmp_path / "out" / "result.json").touch()
    refused("demo -o out", "holds the results of another fit; choose another folder, or replace them with --force", capfd)


@pytest.mark.parametrize("flag", ["", " --force"])
def test_a_fit_never_writes_over_its_own_targets(tmp_path, capfd, flag):
    (tmp_path / "out").mkdir()
    for i in range(2):
        jvr.write_image(f"out/target_0{i}.exr", np.zeros((10, 12, 3)))
    head = FIT.split("[truth]")[0]
    Path("images.toml").write_text(f"{head}[fit]\nimages = ['out/target_00.exr', 'out/target_01.exr']\nstart = {{entries = 6}}\n")
    refused(f"fit images.toml -o out{flag}", "the fit reads out/target_00.exr and would write over it", capfd)


def test_one_fit_a_folder_at_a_time(tmp_path, capfd):
    (tmp_path / "out").mkdir()
    left = tmp_path / "out" / ".checkpoint.npz.0123abcd.part"
    left.touch()
    with alone_in(tmp_path / "out"):
        assert not left.exists()
        refused("fit fit.toml -o out", "another fit is writing there", capfd)
    with alone_in(tmp_path / "out"):
        pass


SCREENSHOTS = """
[volume]
builtin = "demo"
[[camera]]
view = "front"
width = 6
height = 4
[[camera]]
view = "left"
width = 5
height = 5
[settings]
step = 16.0
[fit]
images = ["a.png", "b.png"]
weights = ["mask_a.png", "mask_b.png"]
max_steps = 1
start = { entries = 3 }
"""


@pytest.mark.slow
def test_pictures_of_others_are_fitted_by_what_is_said_of_them(tmp_path, capfd):
    """Screenshots of two sizes with masks: what is assumed is one line, and what has changed since is another."""
    codes = np.random.default_rng(0).integers(0, 256, (5, 6, 3)).astype(np.uint8)
    mask = np.full((5, 6), 255, np.uint8)
    mask[:2, :2] = 0
    for name, rows, columns in (("a", 4, 6), ("b", 5, 5)):
        Image.fromarray(codes[:rows, :columns]).save(f"{name}.png")
        Image.fromarray(mask[:rows, :columns]).save(f"mask_{name}.png")
    Path("shots.toml").write_text(SCREENSHOTS)
    assert cli.run(["fit", "shots.toml", "-o", "out", "--json"]) == 0
    found, lines = capfd.readouterr()
    assert lines.count("\n") == 1
    assert lines.startswith(
        'jvr: warning: pictures of whole numbers that do not say their encoding are taken as sRGB: say encoding = "srgb"'
    )
    report, errors = json.loads(found), []
    for i, name in enumerate("ab"):
        target, fitted, difference = (jvr.read_image(f"out/{kind}_0{i}.exr") for kind in ("target", "fitted", "difference"))
        unknown = np.isnan(target[..., 0])
        np.testing.assert_array_equal(unknown, mask[: len(unknown), : len(unknown[0])] == 0)
        true = jvr.linear_from_srgb(np.asarray(Image.open(f"{name}.png")) / 255)
        errors.append((fitted - true)[~unknown])
        np.testing.assert_allclose(difference[~unknown], errors[-1], atol=1e-6)
        assert report["views"]["psnr"][i] == pytest.approx(-10 * np.log10(np.mean(np.square(errors[-1]))), abs=1e-3)
        assert np.all(jvr.read_image(f"out/target_0{i}.png")[unknown] == 0)
    everything = np.concatenate(errors)
    assert report["views"]["mean_psnr"] == pytest.approx(-10 * np.log10(np.mean(np.square(everything))), abs=1e-3)
    assert report["history"][-1]["psnr"] == pytest.approx(report["views"]["mean_psnr"], abs=1e-2)
    Image.fromarray(255 - mask[:4]).save("mask_a.png")
    for change, named in (("fit.encoding=linear", "images, weights"), ("fit.encoding=srgb", "images, weights")):
        refused(f"fit shots.toml -o out --resume --set {change}", f"is of another fit ({named} changed since)", capfd)
    refused("fit shots.toml -o mask_a.png", "mask_a.png: this is a file", capfd)


@pytest.mark.slow
def test_force_replaces_all_results_of_the_other_fit(tmp_path, capfd):
    (tmp_path / "out").mkdir()
    for name in ("fitted_07.png", "result.json", "notes.txt"):
        (tmp_path / "out" / name).write_text("old")
    assert cli.run(["fit", "fit.toml", "-o", "out", "--force", "--set", "fit.max_steps=1"]) == 0
    assert (tmp_path / "out" / "notes.txt").read_text() == "old"
    assert not (tmp_path / "out" / "fitted_07.png").exists()
    assert json.loads((tmp_path / "out" / "result.json").read_text())["command"] == "fit"
    modes = {stat.S_IMODE(path.stat().st_mode) for path in (tmp_path / "out").iterdir()}
    assert len(modes) == 1


# --- Whole or not at all ---------------------------------------------------------------------------------------------


def test_a_replaced_file_keeps_its_mode_and_its_links(tmp_path):
    (tmp_path / "real").write_text("old")
    (tmp_path / "real").chmod(0o640)
    (tmp_path / "link").symlink_to("real")
    with replacing(tmp_path / "link") as temporary:
        temporary.write_text("new")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "real").read_text() == "new"
    assert stat.S_IMODE((tmp_path / "real").stat().st_mode) == 0o640


def test_a_write_protected_picture_stays(tmp_path, monkeypatch):
    jvr.write_image("a.png", np.zeros((2, 2, 3)))
    before = Path("a.png").read_bytes()
    monkeypatch.setattr(os, "access", lambda *_: False)  # who runs this may be allowed to do everything
    with pytest.raises(PermissionError, match=r"a\.png: the file is write-protected; choose another name"):
        jvr.write_image("a.png", np.ones((2, 2, 3)))
    assert Path("a.png").read_bytes() == before


def test_old_parts_of_a_killed_process_go(tmp_path):
    old, new = tmp_path / ".a.png.0123abcd.part", tmp_path / ".a.png.0123abce.part"
    for path in (old, new):
        path.touch()
    os.utime(old, (time.time() - 2e5,) * 2)
    jvr.write_image(tmp_path / "a.png", np.zeros((2, 2, 3)))
    assert {path.name for path in tmp_path.iterdir()} == {new.name, "a.png", "fit.toml"}


def test_a_checkpoint_has_the_mode_of_its_siblings(tmp_path):
    (tmp_path / "sibling").touch()
    checkpoint.save(tmp_path / "c.npz", {"x": np.ones(3)}, [], {})
    assert (tmp_path / "c.npz").stat().st_mode == (tmp_path / "sibling").stat().st_mode


def test_a_full_disk_is_one_line(monkeypatch, capfd):
    def full(*_, **__):
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr("typer.echo", full)
        assert cli.run(["plan", "fit.toml"]) == 1
    assert capfd.readouterr().err == "jvr: No space left on device: output is cut short\n"
    monkeypatch.setattr(os, "replace", full)
    for name in ("a.png", "a.exr"):
        with pytest.raises(OSError, match=f"{name}: cannot be written: No space left on device; choose another name"):
            jvr.write_image(name, np.zeros((2, 2, 3)))
    assert sorted(os.listdir()) == ["fit.toml"]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["a.exr", "a.png"])
def test_a_picture_that_finds_no_room_is_one_line(name):
    limited = f"ulimit -f 1; exec {sys.executable} -c 'from jvr.cli import main; main()' render fit.toml -o {name} --size 64"
    done = subprocess.run(["bash", "-c", limited], capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr.endswith("cannot be written: File too large; choose another name or folder, or make room\n")
    assert done.stderr.count("\n") == 1
    assert os.listdir() == ["fit.toml"]


# --- Signals ---------------------------------------------------------------------------------------------------------


@pytest.fixture
def heard():
    """A shell lets what runs in its background ignore SIGINT, which processes hand on to those that they start."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize(
    ("name", "seconds"),
    [
        ("SIGTERM", 1.0),
        *(
            pytest.param(n, s, marks=pytest.mark.slow)
            for n, s in (("SIGINT", 0.5), ("SIGTERM", 2), ("SIGINT", 4), ("SIGTERM", 7))
        ),
    ],
)
def test_a_signal_ends_a_command_in_one_line_whenever_it_comes(name, seconds, heard):
    """In imports, while something is compiled, while pictures are made."""
    process = subprocess.Popen([*JVR, "fit", "fit.toml", "-o", "out"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    time.sleep(seconds)
    process.send_signal(getattr(signal, name))
    out, err = process.communicate(timeout=30)
    assert process.returncode == 128 + getattr(signal, name)
    assert out == ""
    assert err.startswith("jvr: interrupted" if name == "SIGINT" else "jvr: terminated")
    assert err.count("\n") == 1
    assert not list(Path().rglob("*.part"))


def test_a_signal_that_is_swallowed_counts_all_the_same(heard):
    code = (
        "from jvr.cli import signals; import time; signals.GRACE = 0.1; signals.catch()\n"
        "while True:\n try: print('ready', flush=True); time.sleep(60)\n except KeyboardInterrupt: time.sleep(60)"
    )
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "ready\n"
    process.send_signal(signal.SIGINT)
    assert process.communicate(timeout=30)[1] == "jvr: interrupted\n"
    assert process.returncode == 130


# --- Fits that end well, and that go on ------------------------------------------------------------------------------


def _adam(rate=0.05):
    return optx.OptaxMinimiser(optax.adam(rate), rtol=1e-6, atol=1e-6)


SOLVERS = {
    "gauss-newton": jvr.GaussNewton,
    "dogleg": jvr.Dogleg,
    "lbfgsb": jvr.LBFGSB,
    "lbfgs": lambda: optx.LBFGS(1e-6, 1e-8),
    "adam": _adam,
    "least squares of Optimistix": lambda: optx.LevenbergMarquardt(1e-6, 1e-8),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", SOLVERS)
def test_a_fit_goes_on_with_every_solver(tmp_path, name):
    """The solver is made anew, as by another process."""
    path = tmp_path / "fit.npz"
    whole = fit(solver=SOLVERS[name](), max_steps=3)
    fit(solver=SOLVERS[name](), max_steps=2, checkpoint=path)
    resumed = fit(solver=SOLVERS[name](), max_steps=3, checkpoint=path, resume=True)
    assert [entry.loss for entry in resumed.history] == [entry.loss for entry in whole.history]
    changed = jvr.Settings(step=0.8, termination=0.0)
    if name == "adam":
        with pytest.raises(checkpoint.CheckpointError, match=r"is of another fit \(solver changed since\)"):
            fit(solver=_adam(0.06), max_steps=3, checkpoint=path, resume=True)
        with pytest.raises(checkpoint.CheckpointError, match=r"kept samples|settings"):
            fit(solver=_adam(), settings=changed, max_steps=3, checkpoint=path, resume=True)


@pytest.mark.slow
@pytest.mark.parametrize("solver", [None, jvr.LBFGSB(), _adam()], ids=["levenberg-marquardt", "lbfgsb", "adam"])
def test_pictures_that_are_exact_from_the_start_and_tiny_views_end_well(solver):
    flat = jvr.PerspectiveCamera(CAMERAS[0].world_from_camera, 30.0, 9, 2)
    result = jvr.fit(
        TRUTH,
        CAMERAS,
        IMAGES,
        unknowns=both,
        settings=jvr.Settings(step=0.7, termination=0.0),
        solver=solver,
        held_out=((flat,), [np.zeros((2, 9, 3))]),
        progress=False,
    )
    assert result.outcome is jvr.Outcome.CONVERGED
    assert len(result.history) <= 2  # with a part of the rays, then with all
    np.testing.assert_allclose(result.scene.transfer.rgb, TRUTH.transfer.rgb, atol=1e-4)
    ((decibels, ssim),) = result.stats.held_out
    assert np.isfinite(decibels)
    assert -1 <= ssim < 0.9


def test_structural_similarity_of_small_and_equal_pictures():
    a = np.random.default_rng(0).random((2, 1, 3))
    assert similarity(a, a) == 1
    assert similarity(0 * a, 0 * a, 1e-300) == 1
    # Without structure, the brightness alone counts: (2 x y + c1) / (x^2 + y^2 + c1).
    x, y = np.full((2, 2, 3), 0.2), np.full((2, 2, 3), 0.4)
    assert similarity(x, y) == pytest.approx((0.16 + 1e-4) / (0.2 + 1e-4), rel=1e-6)


# --- Codes are not radiance ------------------------------------------------------------------------------------------

CODES = np.full((15, 16, 3), 200, np.uint8)
TABLE = [[0, 0, 0], [1, 1, 1]]


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda: jvr.write_image("a.png", CODES),
            r"a.png: the image holds whole numbers \(uint8\).*linear_from_srgb\(codes / 255\)",
        ),
        (lambda: jvr.write_image("a.exr", CODES.astype(np.uint16)), r"linear_from_srgb\(codes / 65535\)"),
        (lambda: jvr.write_image("a.exr", CODES > 3), "whole numbers"),
        (lambda: fit(images=[CODES] * 3), r"target image 0 holds whole numbers \(uint8\)"),
        (lambda: fit(images=[CODES.astype(np.float32)] * 3), "target image 0 holds whole numbers up to 200"),
        (lambda: jvr.residuals(TRUTH, CAMERAS, [CODES] * 3), "target image 0 holds whole numbers"),
        (lambda: jvr.Scene(VOLUME, TRUTH.transfer, background=[255, 255, 255]), "background goes up to 255, but 1 is white"),
        (lambda: jvr.Scene(VOLUME, TRUTH.transfer, background=(20, 40, 60)), "background goes up to 60"),
        (lambda: jvr.Scene(VOLUME, TRUTH.transfer, background=[0, 0, np.nan]), "background must be finite and not negative"),
        (lambda: jvr.Scene(VOLUME, TRUTH.transfer, background=[0, -0.1, 0]), "background must be finite and not negative"),
        (lambda: jvr.Scene(VOLUME, TRUTH.transfer, background=[0, 0, 1e20]), r"background goes up to 1e\+20"),
        (lambda: jvr.LinearTransfer([0, 1], [[0, 0, 0], [255, 9, 0]], [0, 1]), "rgb goes up to 255"),
        (lambda: jvr.LutTransfer(np.float32(TABLE) * 255, [0, 1], (0, 1)), "rgb goes up to 255"),
        (lambda: jvr.GaussianTransfer([0.5], [0.1], [1.0], [[-1.0, 0, 0]]), "rgb must be finite and not negative"),
        (lambda: jvr.GradientTransfer([TABLE, np.int16(TABLE) * 3], np.ones((2, 2)), (0, 1), (0, 1)), "rgb goes up to 3"),
        (lambda: jvr.DirectionalLight([0, 0, 1], CODES[0, 0]), r"irradiance holds codes \(uint8\)"),
        (lambda: jvr.PointLight([0, 0, 1], 1e30), r"intensity must be at most 1e\+15"),
        (lambda: jvr.AmbientLight(-1), "radiance must be finite and not negative"),
        (lambda: jvr.EnvironmentLight.constant(np.nan), "radiance must be finite and not negative"),
        (lambda: jvr.EnvironmentLight.from_image(np.full((4, 8, 3), 9, np.uint8)), "an environment map holds whole numbers"),
    ],
)
def test_codes_and_impossible_radiance_are_named(call, message):
    with pytest.raises(ValueError, match=message):
        call()
    assert os.listdir() == ["fit.toml"]


@pytest.mark.parametrize("colour", ["[255,255,255]", "[20,40,60]", "[0,-1,0]", "[1e9,0,0]"])
def test_codes_in_a_configuration_are_named(colour, capfd):
    refused(f"render fit.toml -o a.png --set background={colour}", "background", capfd)


def test_what_is_radiance_is_taken():
    for background in ([0, 1, 1], (0.5, 2.5, 7.0), np.float32([1, 1, 1]), jnp.ones(3)):
        assert jvr.Scene(VOLUME, TRUTH.transfer, background=background).background.shape == (3,)
    assert jvr.PointLight([0, 0, 1], 20_000).intensity == 20_000


# --- Pictures of one's own -------------------------------------------------------------------------------------------


def picture():
    rgb, plane = jnp.full((3, 4, 3), 0.5).at[0, 0].set(jnp.nan), jnp.full((3, 4), 0.5)
    return jvr.Rendering(rgb, plane, 2 * plane, jvr.RenderStats(jnp.zeros((3, 4), jnp.int32)))


def test_a_rendering_saves_itself(tmp_path):
    picture().save(tmp_path / "a.exr")
    np.testing.assert_array_equal(jvr.read_image(tmp_path / "a.exr"), picture().rgb)
    with pytest.raises(ValueError, match="1 pixels are not finite"):
        picture().save(tmp_path / "a.png")
    whole = jvr.Rendering(jnp.full((3, 4, 3), 0.5), picture().alpha, picture().depth, picture().stats)
    whole.save(tmp_path / "a.png")
    whole.save(tmp_path / "b.png", transparent=True)
    assert np.asarray(Image.open(tmp_path / "a.png"))[1, 1].tolist() == [188, 188, 188]
    assert np.asarray(Image.open(tmp_path / "b.png"))[1, 1].tolist() == [255, 255, 255, 128]


def test_a_rendering_shows_itself_in_a_notebook(tmp_path):
    (tmp_path / "shown.png").write_bytes(picture()._repr_png_())
    shown = np.asarray(Image.open(tmp_path / "shown.png"))
    assert shown.shape == (3, 4, 3)
    assert shown[1, 1].tolist() == [188, 188, 188]
    assert shown[0, 0].tolist() == [255, 0, 255]


def test_objects_show_themselves_in_a_notebook():
    shown = VOLUME._repr_html_()
    assert shown.count("<img") == 3
    assert "12 x 13 x 11" in shown
    tables = np.ones((2, 2, 3)), np.ones((2, 2))
    gradient = jvr.GradientTransfer(*tables, (0, 1), (0, 2))
    for transfer in (TRUTH.transfer, jvr.GradientOpacity(TRUTH.transfer, 0, 1), gradient, jvr.presets.ct_bone()):
        assert transfer._repr_html_().count("<img") == 1
    assert "150 ... 1500" in jvr.presets.ct_bone()._repr_html_()
    stats = jvr.fitting.fit.FitStats(1.0, 0, 0.01, 2, 3.0, (), ())
    errors = (np.full((8, 3), np.inf), np.full(8, 0.25))
    result = jvr.FitResult(TRUTH, (), errors, ("transfer.rgb", "transfer.sigma_t"), jvr.Outcome.CONVERGED, 1.0, stats)
    assert "converged after 0 steps" in result._repr_html_()
    assert "24 of 24 not determined" in result._repr_html_()
    assert "standard error 0.25" in result._repr_html_()


# --- The command itself ----------------------------------------------------------------------------------------------


def test_version_and_help(capfd):
    assert cli.run(["--version"]) == 0
    assert capfd.readouterr().out == f"jvr {jvr.__version__}\n"
    assert cli.run(["fit", "--help"]) == 0
    assert "[radiance_transfer] frozen = false" in capfd.readouterr().out


def test_tab_completion_answers_without_jax():
    environment = {**os.environ, "_JVR_COMPLETE": "complete_bash", "COMP_WORDS": "jvr fit --res", "COMP_CWORD": "2"}
    done = subprocess.run(JVR, capture_output=True, text=True, env=environment, timeout=60, check=True)
    assert done.stdout.split() == ["--resume"]
    code = "import sys; from jvr.cli import run; run(['--help']); print([m for m in ('jax', 'numpy') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout.splitlines()[-1] == "[]"
