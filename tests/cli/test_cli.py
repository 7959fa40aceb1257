"""The command line: exit status, one line for every mistake, nothing half written, resuming, machine-readable output."""

import json
import os
import shutil
import stat
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest

import jvr
from jvr import cli
from jvr.io import interop
from jvr.io.config import read_transfer
from jvr.io.images import read_image

FIT = """
[volume]
builtin = "demo"
[camera]
kind = "fibonacci"
count = 2
fov_y = 40.0
width = 12
height = 10
[settings]
step = 1.0
[truth]
kind = "linear"
positions = [0.0, 0.3, 0.6, 1.0]
rgb = [[0.1, 0.2, 0.5], [0.2, 0.4, 0.9], [1.0, 0.7, 0.2], [1.0, 0.1, 0.1]]
sigma_t = [0.0, 0.03, 0.2, 0.5]
[fit]
max_steps = 5
held_out = 1
solver = "levenberg-marquardt"
[fit.start]
entries = 6
domain = [0.0, 1.0]
"""
LIGHT = """
[volume]
builtin = "demo"
[camera]
kind = "fibonacci"
count = 2
width = 8
height = 8
[settings]
step = 4.0
[truth]
kind = "linear"
positions = [0.2, 0.5]
rgb = [[0.0, 0.0, 0.0], [0.0, 0.0, 0.0]]
sigma_t = [0.0, 0.2]
gradient_opacity = { low = 0.0, high = 0.01 }
[[lights]]
kind = "directional"
direction = [1, 0.5, -1]
irradiance = 3.0
[scattering.phase]
kind = "henyey-greenstein"
g = 0.4
[fit]
unknowns = ["scattering.phase.g", "lights.0.irradiance"]
max_steps = 3
[fit.initial]
scattering.phase.g = 0.1
lights.0.irradiance = 2.0
"""


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    """Every test runs in a folder of its own, without the user's data and cache."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("JVR_DATA", raising=False)
    monkeypatch.setenv("JVR_CACHE", "0")
    (tmp_path / "fit.toml").write_text(FIT)
    np.save(tmp_path / "volume.npy", np.linspace(-1000, 1000, 6 * 7 * 8, dtype=np.float32).reshape(6, 7, 8))


def snapshot(folder):
    return {path: path.read_bytes() if path.is_file() else None for path in folder.rglob("*")}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("line", "hint"),
    [
        ("rendr fit.toml", "rendr"),
        ("render", "CONFIG|VOLUME"),
        ("render fit.toml --sze 5", "--size"),
        ("render fit.toml --size big -o a.png", "--size"),
        ("render fit.toml --size 0 -o a.png", "--size"),
        ("render fti.toml -o a.png", "did you mean 'fit.toml'?"),
        ("render volum.npy -o a.png", "volum.npy: no such file"),
        ("render fit.toml -o a.jpg", ".exr (linear) or .png (sRGB)"),
        ("render fit.toml -o a/b/c.png", "does not exist"),
        ("render fit.toml -o folder.png", "this is a folder"),
        ("render fit.toml -o kept.png --set settings.step=0.5mm", "settings.step"),
        ("render fit.toml -o kept.png --set settings.stp=1", "did you mean 'step'?"),
        ("render fit.toml -o kept.png --set volume.path=x.mhd", "$JVR_DATA"),
        ("render fit.toml -o kept.png --preset ct_bone", "--preset"),
        ("render volume.npy -o kept.png --preset ct_bones", "did you mean 'ct_bone'?"),
        ("render volume.npy -o kept.png --preset CT-Bon", "did you mean 'CT-Bone'?"),
        ("preset CT-Bon -o a.toml", "did you mean 'CT-Bone'?"),
        ("preset CT-Bone -o a.xml", "written as .toml, .vp.json, .vp or .json"),
        ("preset none.vp -o a.toml", "none.vp"),
        ("preset kept.png -o a.toml", "neither a preset of 3D Slicer nor .toml"),
        ("preset CT-Bone -o a.toml --range 0,1", "--range"),
        ("preset CT-Bone -o a.toml --unit-distance 0", "--unit-distance 0"),
        ("preset CT-Bone -o a.toml --encoding gamma", "--encoding gamma"),
        ("preset fit.toml -o fit.toml", "would change fit.toml, which is read"),
        ("render volume.npy -o kept.png --shape 6,7", "--shape"),
        ("render kept.png -o kept.png", "one picture is no volume"),
        ("render fit.toml -o kept.png --set shadows=['rays','map']", "'rays' and 'map' exclude each other"),
        ("render fit.toml -o kept.png --set shadows=rays", "no light that casts them"),
        ("render fit.toml -o kept.png --set lights=haed", "did you mean 'head'?"),
        ("fit fit.toml -o new --set fit.unknowns=['lights[0].direction']", "fit.unknowns[0]"),
        ("render fit.toml -o kept.png --set settings.sampling=slices --set shading=lambert", "jvr.Slices() does not know light"),
        ("fit fit.toml", "--output"),
        ("fit fit.toml -o kept.png", "this is a file"),
        ("fit fit.toml -o new --resume", "--resume"),
        ("fit fit.toml -o new --set fit.solvr=x", "did you mean 'solver'?"),
        ("fit fit.toml -o new --set fit.unknowns=['transfer.rbg']", "did you mean 'transfer.rgb'?"),
        ("fit fit.toml -o new --set truth={}", "truth.kind"),
        ("plan volume.npy --set settings.tile=0", "settings.tile"),
        ("info volume.nii", "volume.npy"),
        ("info fit.toml", "unsupported extension"),
        ("info volume.npy --spacing 1,0,1", "--spacing"),
        ("demo -o kept.png", "this is a file"),
        ("demo -o new --set fit.max_steps=many", "fit.max_steps"),
    ],
)
def test_bad_input_is_one_line_and_status_2(line, hint, tmp_path, capfd):
    (tmp_path / "kept.png").write_text("precious")
    (tmp_path / "folder.png").mkdir()
    before = snapshot(tmp_path)
    assert cli.run(line.split()) == 2
    printed = capfd.readouterr()
    assert printed.out == ""
    assert printed.err.count("\n") == 1
    assert printed.err.startswith("jvr: ")
    assert hint in printed.err
    assert snapshot(tmp_path) == before


def test_a_write_protected_output_is_refused_before_work(tmp_path, capsys, monkeypatch):
    if os.access("/proc/version", os.W_OK) and os.geteuid() != 0:
        pytest.skip("needs a folder that cannot be written to")
    folder = Path("/proc") if os.geteuid() == 0 else tmp_path / "locked"
    if os.geteuid() != 0:
        folder.mkdir()
        folder.chmod(stat.S_IRUSR | stat.S_IXUSR)
    for line in (f"render fit.toml -o {folder}/a.png", f"fit fit.toml -o {folder}/out"):
        assert cli.run(line.split()) == 2
        assert str(folder) in capsys.readouterr().err


def test_help_shows_examples(capsys):
    assert cli.run([]) == 0
    assert "render" in capsys.readouterr().out
    for command in ("render", "fit", "next-view", "plan", "info", "demo", "preset"):
        assert cli.run([command, "--help"]) == 0
        assert f"jvr {command}" in capsys.readouterr().out.split("Examples")[1]


def test_a_configuration_renders_to_png_and_exr(tmp_path, capsys):
    one_camera = ["--set", "camera={width=9, height=7}"]
    assert cli.run(["render", "fit.toml", "-o", "a.exr", "--json", *one_camera]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["outputs"] == ["a.exr"]
    assert report["pictures"][0]["width"] == 9
    assert report["versions"]["jvr"]
    image = read_image("a.exr")
    assert image.shape == (7, 9, 3)
    assert image.max() > 0.05
    assert cli.run(["render", "fit.toml", "-o", "a.png", *one_camera, "--set", "background=[0,0,0]"]) == 0
    np.testing.assert_allclose(read_image("a.png"), image, atol=0.02)


def test_several_cameras_give_numbered_pictures(tmp_path):
    assert cli.run(["render", "fit.toml", "-o", "a.png", "--size", "6"]) == 0
    assert {path.name for path in tmp_path.glob("*.png")} == {"a_00.png", "a_01.png"}
    assert read_image("a_00.png").shape == (6, 6, 3)


@pytest.mark.slow
@pytest.mark.parametrize("flags", ["", "--preset ct_bone", "--preset CT-Muscle"])
def test_a_volume_file_renders_directly(flags, tmp_path):
    assert cli.run(f"render volume.npy -o v.png --size 8 {flags}".split()) == 0
    assert read_image("v.png").max() > 0.05


def test_presets_are_converted(capfd):
    assert cli.run(["preset", "CT-Bone", "-o", "a.toml"]) == 0
    printed = capfd.readouterr()
    assert '[shading]  kind = "phong", ambient = 0.1, diffuse = 0.9, specular = 0.2, shininess = 10' in printed.out
    assert printed.err == ""
    assert cli.run(["preset", "a.toml", "-o", "a.json", "--name", "bone"]) == 0
    assert cli.run(["preset", "a.json", "-o", "b.vp.json", "--name", "bone", "--range", "0,100", "--unit-distance", "2"]) == 0
    capfd.readouterr()
    assert cli.run(["preset", "CT-Soft-Tissue", "-o", "c.vp", "--json"]) == 0
    printed = capfd.readouterr()
    assert list(json.loads(printed.out)["lost"]) == ["opacity of 1"]
    assert printed.err.startswith("jvr: warning: CT-Soft-Tissue: not kept: opacity of 1")
    one, other = read_transfer("a.toml"), interop.slicer_preset("CT-Bone").transfer
    np.testing.assert_array_equal(one.sigma_t, other.sigma_t)
    moved = interop.read_slicer("b.vp.json")
    assert moved.unit_distance == 2
    np.testing.assert_allclose(moved.transfer.ends, (0, 100))


def test_plan_and_info_as_text_and_json(tmp_path, capsys):
    assert cli.run(["plan", "fit.toml"]) == 0
    assert "+ early termination" in capsys.readouterr().out
    assert cli.run(["plan", "fit.toml", "--json", "--set", "settings.termination=0"]) == 0
    parts = {part["name"]: part["included"] for part in json.loads(capsys.readouterr().out)["parts"]}
    assert not parts["early termination"]
    assert cli.run(["info", "volume.npy", "--json", "--spacing", "1,2,3"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["shape"], found["spacing"]) == ([6, 7, 8], [1, 2, 3])
    np.arange(24, dtype=">i2").tofile("v.raw")
    assert cli.run(["info", "v.raw", "--shape", "2x3x4", "--dtype", ">i2"]) == 0
    assert "0 ... 23" in capsys.readouterr().out


@pytest.mark.slow
def test_an_interrupted_fit_goes_on_to_the_same_answer(tmp_path, capfd, monkeypatch):
    assert cli.run(["fit", "fit.toml", "-o", "whole", "--json"]) == 0
    whole = json.loads(capfd.readouterr().out)
    save, calls = jvr.fitting.checkpoint.save, []

    def interrupted(*arguments):
        save(*arguments)
        calls.append(1)
        if len(calls) == 2:
            raise KeyboardInterrupt

    monkeypatch.setattr("jvr.fitting.checkpoint.save", interrupted)
    assert cli.run(["fit", "fit.toml", "-o", "halves"]) == 130
    printed = capfd.readouterr().err
    assert printed.count("\n") == 1
    assert "checkpoint.npz is kept" in printed
    assert {path.name for path in (tmp_path / "halves").iterdir()} == {"checkpoint.npz"}

    assert cli.run(["fit", "fit.toml", "-o", "halves", "--resume", "--json"]) == 0
    halves = json.loads(capfd.readouterr().out)
    assert len(halves["history"]) == len(whole["history"])
    assert [h["loss"] for h in halves["history"]] == [h["loss"] for h in whole["history"]]
    assert (tmp_path / "halves/transfer.toml").read_text(encoding="utf-8") == (tmp_path / "whole/transfer.toml").read_text(
        encoding="utf-8"
    )

    _folder_of_a_fit(tmp_path / "whole", whole)
    before = snapshot(tmp_path)
    # The targets are rendered with the settings, too.
    assert cli.run(["fit", "fit.toml", "-o", "whole", "--resume", "--set", "settings.step=0.9"]) == 2
    assert "checkpoint.npz: is of another fit (images, settings changed since)" in capfd.readouterr().err
    assert snapshot(tmp_path) == before


def _folder_of_a_fit(folder, printed):
    """Everything that a fit writes is there, whole, and agrees."""
    names = {path.name for path in folder.iterdir()}
    views = [f"{kind}_{view}" for kind in ("target", "fitted", "difference") for view in ("00", "01", "held_out_00")]
    assert {f"{view}{ending}" for view in views for ending in (".exr", ".png")} <= names
    assert not [name for name in names if name.endswith(".part")]
    assert "jvr fit fit.toml -o whole" in (folder / printed["page"]).read_text(encoding="utf-8")
    report = json.loads((folder / "result.json").read_text(encoding="utf-8"))
    assert report == printed
    assert report["views"]["mean_psnr"] > report["history"][0]["psnr"]
    assert report["settings"]["step"] == 1.0
    assert report["device"]["platform"]
    errors = report["standard_errors"]
    assert (len(errors["transfer.rgb"]), len(errors["transfer.sigma_t"])) == (6, 6)
    assert read_transfer(folder / "transfer.toml").rgb.shape == (6, 3)
    difference = read_image(folder / "fitted_00.exr") - read_image(folder / "target_00.exr")
    np.testing.assert_allclose(read_image(folder / "difference_00.exr"), difference, atol=1e-6)
    mean = np.mean([np.mean(read_image(folder / f"difference_0{i}.exr") ** 2.0) for i in range(2)])
    assert report["views"]["mean_psnr"] == pytest.approx(-10 * np.log10(mean), abs=1e-3)


@pytest.mark.slow
def test_a_fit_of_light_through_the_command_line(tmp_path, capsys):
    """With a transfer function of the gradient, which is no curve to draw."""
    (tmp_path / "light.toml").write_text(LIGHT)
    assert cli.run(["fit", "light.toml", "-o", "out", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert list(report["standard_errors"]) == ["scattering.phase.g", "lights[0].irradiance"]
    assert report["history"][-1]["psnr"] > report["history"][0]["psnr"]
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert "scattering.phase.g" in page
    assert isinstance(read_transfer(tmp_path / "out" / "transfer.toml"), jvr.GradientOpacity)


@pytest.mark.slow
def test_images_in_files_can_be_fitted_and_must_fit_their_cameras(tmp_path, capfd):
    assert cli.run(["render", "fit.toml", "-o", "t.exr"]) == 0
    (tmp_path / "images.toml").write_text(
        FIT.split("[truth]")[0] + "[fit]\nimages = ['t_00.exr', 't_01.exr']\nmax_steps = 1\nstart = {entries = 6}\n"
    )
    capfd.readouterr()
    assert cli.run(["fit", "images.toml", "-o", "out", "--json"]) == 0
    assert json.loads(capfd.readouterr().out)["held_out"]["psnr"] == []
    for change, hint in (
        ("camera.width=13", "resize"),
        ("camera.count=3", "2 images for 3 cameras"),
        ("fit.images[1]=t_02.exr", "fit.images[1]"),
        ("fit.held_out=[7]", "fit.held_out"),
    ):
        assert cli.run(["fit", "images.toml", "-o", "new", "--set", change]) == 2
        assert hint in capfd.readouterr().err


def test_an_error_of_our_own_is_not_taken_for_bad_input(monkeypatch):
    def broken(*arguments, **keywords):
        raise ValueError("a mistake in the program")

    monkeypatch.setattr("jvr.cli.render._numbers", broken)
    with pytest.raises(ValueError, match="a mistake in the program"):
        cli.run(["render", "fit.toml", "-o", "a.png", "--size", "6"])


@pytest.mark.slow
def test_the_installed_command_starts_and_refuses(tmp_path):
    environment = {**os.environ, "JVR_CACHE": "0"}
    command = [sys.executable, "-c", "from jvr.cli import main; main()", "render", "other/no.toml"]
    done = subprocess.run(command, capture_output=True, encoding="utf-8", env=environment, timeout=60)
    assert done.returncode == 2
    assert done.stderr == "jvr: other/no.toml: no such file\n"


@pytest.mark.slow
def test_an_installed_wheel_has_the_demo(tmp_path):
    """`jvr demo` needs no repository: the wheel, unpacked elsewhere, finds its configuration in itself."""
    pytest.importorskip("setuptools", reason="builds a wheel without the network")
    repository, source, installed = Path(__file__).parents[2], tmp_path / "source", tmp_path / "installed"
    source.mkdir()
    for folder in ("jvr", "configs"):
        shutil.copytree(repository / folder, source / folder)
    for name in ("pyproject.toml", "setup.py", "README.md", "LICENSE"):
        shutil.copy(repository / name, source)
    build = ["wheel", "--quiet", "--no-build-isolation", "--no-deps", "--wheel-dir", tmp_path, source]
    subprocess.run([sys.executable, "-m", "pip", *map(str, build)], check=True, capture_output=True, timeout=120)
    (wheel,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(installed)
    code = (
        "import jvr; from jvr.cli.fit import demo_config; print(demo_config()); from jvr.cli import run; run(['demo', '--help'])"
    )
    environment = {**os.environ, "PYTHONPATH": str(installed), "JVR_CACHE": "0"}
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, encoding="utf-8", env=environment, check=True, timeout=60
    )
    assert Path(done.stdout.splitlines()[0]) == installed / "jvr" / "configs" / "demo.toml"
    assert (installed / "jvr" / "configs" / "demo.toml").read_text(encoding="utf-8") == (
        repository / "configs" / "demo.toml"
    ).read_text(encoding="utf-8")
    assert "jvr demo" in done.stdout
    assert (installed / "jvr" / "io" / "interop" / "slicer.toml").is_file()
    # A package that the wheel forgets is still there for everyone who works in the repository.
    modules = lambda root: {path.relative_to(root).as_posix() for path in (root / "jvr").rglob("*.py")}
    assert modules(installed) == modules(repository)


def test_the_compilation_cache_lies_in_the_users_cache_folder(tmp_path, monkeypatch):
    import jax

    from jvr.cli.runtime import start_jax

    monkeypatch.setenv("JVR_CACHE", "1")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR", raising=False)
    before = jax.config.jax_compilation_cache_dir
    try:
        start_jax()
        assert jax.config.jax_compilation_cache_dir == str(tmp_path / "cache" / "jvr" / "xla")
    finally:
        jax.config.update("jax_compilation_cache_dir", before)


ENVIRONMENT = """
[volume]
builtin = "demo"
[camera]
kind = "fibonacci"
count = 1
width = 6
height = 6
[settings]
step = 4.0
[truth]
kind = "linear"
positions = [0.2, 0.5]
rgb = [[0.9, 0.9, 0.9], [0.9, 0.5, 0.2]]
sigma_t = [0.0, 0.2]
[[environment]]
kind = "constant"
radiance = 0.5
[[environment]]
kind = "disc"
towards = [0, 0, 1]
half_angle = 30
radiance = 3.0
order = 1
[material]
kind = "phase"
phase = "isotropic"
[radiance_transfer]
rays = 4
order = 1
resolution = 0.05
[fit]
unknowns = ["transfer.sigma_t"]
max_steps = 2
[fit.start]
entries = 3
sigma_t = 0.1
domain = [0.0, 1.0]
"""


@pytest.fixture
def cached(tmp_path, monkeypatch):
    """A cache in the folder of the test, and none of compiled programs."""
    monkeypatch.setenv("JVR_CACHE", "1")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", "")
    (tmp_path / "natural.toml").write_text(ENVIRONMENT)


@pytest.mark.slow
def test_what_is_computed_beforehand_is_said_and_kept(cached, tmp_path, capsys):
    """By the second command it is read, and the picture is the same."""
    pictures = []
    for cached_before in (False, True):
        assert cli.run(["render", "natural.toml", "-o", "a.exr", "--json"]) == 0
        report = json.loads(capsys.readouterr().out)
        assert [(p["part"], p["cached"]) for p in report["precomputed"]] == [
            ("material", cached_before),
            ("radiance transfer", cached_before),
        ]
        assert all(p["nbytes"] > 0 and p["seconds"] > 0 for p in report["precomputed"])
        pictures.append(read_image(tmp_path / "a.exr"))
    np.testing.assert_array_equal(*pictures)
    assert len(list((tmp_path / "cache" / "jvr" / "precomputed").iterdir())) == 2
    assert cli.run(["render", "natural.toml", "-o", "a.png"]) == 0
    assert "radiance transfer: read from the cache in" in capsys.readouterr().out
    assert cli.run(["plan", "natural.toml"]) == 0
    assert "computed beforehand" in capsys.readouterr().out


@pytest.mark.slow
def test_a_fit_with_a_kept_radiance_transfer_says_what_that_is_worth(cached, capfd):
    assert cli.run(["fit", "natural.toml", "-o", "out"]) == 0
    printed = capfd.readouterr()
    assert "with the radiance transfer of what was found, not of the start: PSNR" in printed.out
    assert "another transfer function" not in printed.err
    report = json.loads(Path("out/result.json").read_text())
    assert report["transfer_kept"]["mean_psnr"] < report["views"]["mean_psnr"]
    assert {p["part"] for p in report["precomputed"]} == {"material", "radiance transfer"}
