"""`jvr next-view`: the folder of a fit is enough, and what it cannot do is one line."""

import json
import shutil
import tomllib

import numpy as np
import pytest

import jvr
from jvr import cli
from jvr.io.config import build_fit, read_config
from jvr.io.config.cameras import write_cameras
from jvr.io.demo import demo_volume
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
step = 2.0
[truth]
kind = "linear"
positions = [0.0, 0.3, 0.6, 1.0]
rgb = [[0.1, 0.2, 0.5], [0.2, 0.4, 0.9], [1.0, 0.7, 0.2], [1.0, 0.1, 0.1]]
sigma_t = [0.0, 0.03, 0.2, 0.5]
[fit]
max_steps = 2
[fit.start]
entries = 6
domain = [0.0, 1.0]
"""


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder with a configuration and the folder of its fit."""
    folder = tmp_path_factory.mktemp("fit")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setenv("JVR_CACHE", "0")
        (folder / "fit.toml").write_text(FIT)
        assert cli.run(["fit", "fit.toml", "-o", "out"]) == 0
    return folder


@pytest.fixture
def here(place, monkeypatch):
    monkeypatch.chdir(place)
    monkeypatch.setenv("JVR_CACHE", "0")
    return place


@pytest.mark.slow
def test_a_finished_fit_ranks_cameras_of_a_file(here, capfd):
    """As the library does with the result of the same fit."""
    eyes = [[0.0, -150.0, 0.0], [0.0, -300.0, 0.0]]
    cameras = [{"position": eye, "focal_point": [0, 0, 0], "view_up": [0, 0, 1], "width": 12, "height": 10} for eye in eyes]
    (here / "cameras.json").write_text(json.dumps(cameras))
    assert "What one more view would bring" in (here / "out" / "report.html").read_text(encoding="utf-8")
    assert cli.run(["next-view", "out", "--cameras", "cameras.json", "--json"]) == 0
    report = json.loads(capfd.readouterr().out)
    job = build_fit(read_config(here / "fit.toml"))
    result = jvr.fit(job.scene, job.cameras, job.targets, progress=False, **job.keywords)
    views = [jvr.PerspectiveCamera.look_at(eye, (0, 0, 0), (0, 0, 1), 30.0, 12, 10) for eye in eyes]
    ranked = jvr.next_view(result, views)
    assert [view["number"] for view in report["views"]] == [one.number for one in ranked]
    np.testing.assert_allclose([view["bits"] for view in report["views"]], [one.gain for one in ranked], rtol=1e-4)
    for view, one in zip(report["views"], ranked, strict=True):
        assert view["median_error_after"] == pytest.approx({n: float(np.median(e)) for n, e in one.errors.items()}, rel=1e-3)
        np.testing.assert_allclose(view["from"], eyes[view["number"]], atol=1e-3)
    picture = read_image(report["output"])
    assert picture.shape == (10, 2 * 12 + 4, 3)
    assert picture[:, :12].max() > 0.05


@pytest.mark.slow
def test_views_from_all_around_are_printed_best_first(here, capfd):
    assert cli.run(["next-view", "out", "--count", "3", "-o", "best.exr"]) == 0
    head, *lines, last = capfd.readouterr().out.strip().splitlines()
    assert head.split() == ["rank", "view", "from", "bits", "transfer.rgb", "transfer.sigma_t"]
    bits = [float(line.split(")")[1].split()[0]) for line in lines]
    assert len(bits) == 3
    assert bits == sorted(bits, reverse=True)
    assert "best.exr" in last


@pytest.mark.slow
def test_candidates_are_as_far_away_as_cameras_that_were_found(here, capfd):
    """A fit of cameras writes where they were, which is not where it began."""
    shutil.copytree("out", "posed")
    found = jvr.PerspectiveCamera.look_at((0.0, -250.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), 40.0, 12, 10)
    write_cameras(here / "posed" / "cameras.toml", [found])
    assert cli.run(["next-view", "posed", "--count", "3", "--json"]) == 0
    eyes = np.array([view["from"] for view in json.loads(capfd.readouterr().out)["views"]])
    np.testing.assert_allclose(np.linalg.norm(eyes - np.asarray(demo_volume().center), axis=1), 250.0, rtol=1e-5)


@pytest.mark.slow
def test_tables_of_cameras_are_candidates(here, capfd):
    (here / "views.toml").write_text('[[camera]]\nview = "front"\nwidth = 8\nheight = 8\n')
    assert cli.run(["next-view", "out", "--cameras", "views.toml"]) == 0
    assert capfd.readouterr().out.count("\n") == 3


def refused(line: str, hint: str, capfd) -> None:
    assert cli.run(["next-view", *line.split()]) == 2
    printed = capfd.readouterr().err
    assert printed.count("\n") == 1
    assert hint in printed


@pytest.mark.slow
@pytest.mark.parametrize(
    ("line", "hint"),
    [
        ("out --cameras none.json", "none.json"),
        ("out --cameras fit.txt", ".pvcc (ParaView, PyVista) and .json"),
        ("out --cameras empty.toml", "add tables [[camera]]"),
        ("out --cameras away.toml", "candidate 0: no camera sees the volume"),
    ],
)
def test_cameras_that_are_none_are_one_line(line, hint, here, capfd):
    (here / "fit.txt").touch()
    (here / "empty.toml").write_text("[volume]\n")
    (here / "away.toml").write_text("[camera]\neye = [0, 0, 900]\ntarget = [0, 900, 900]\nwidth = 4\nheight = 4\n")
    refused(line, hint, capfd)


@pytest.mark.parametrize(
    ("line", "hint"),
    [
        ("nowhere", "nowhere: no such folder; name the one that jvr fit -o has written"),
        ("empty", "holds no results of a fit"),
        ("unfinished", "holds an unfinished fit; finish it with jvr fit --resume"),
        ("older", "run the fit again, jvr fit --force"),
        ("newer", "written by another version of jvr: run the fit again"),
        ("damaged", "damaged, or not written by a fit"),
        ("incomplete", "damaged, or not written by a fit"),
        ("voxels", "too many unknowns"),
        ("empty --cameras fit.toml --count 3", "leave it or --cameras out"),
        ("empty --count 0", "--count"),
        ("empty -o fit.toml", ".exr (linear) or .png"),
        ("empty -o no/a.png", "does not exist"),
    ],
)
def test_what_cannot_be_ranked_is_one_line(line, hint, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("JVR_CACHE", "0")
    for name in ("empty", "unfinished", "older", "newer", "damaged", "incomplete", "voxels"):
        (tmp_path / name).mkdir()
    (tmp_path / "unfinished" / "checkpoint.npz").touch()
    for name in ("older", "newer", "damaged", "incomplete", "voxels"):
        (tmp_path / name / "result.json").touch()
    config = {"data": tomllib.loads(FIT), "name": "fit.toml", "folder": str(tmp_path)}
    meta = {"version": 1, "config": config, "overridden": [], "unknowns": [], "variance": 1.0, "exposure": 1.0}
    meta["refused"] = "the fit has too many unknowns"
    for name, version in (("newer", 1000), ("voxels", 1)):
        np.savez(tmp_path / name / "knowledge.npz", meta=np.array(json.dumps(meta | {"version": version})))
    np.savez(tmp_path / "incomplete" / "knowledge.npz", meta=np.array(json.dumps(meta | {"unknowns": ["transfer.rgb"]})))
    (tmp_path / "damaged" / "knowledge.npz").write_bytes(b"PK\x03\x04")
    refused(line, hint, capfd)
