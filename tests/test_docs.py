"""The documentation is true: its code runs, its commands parse, and what it names is there."""

import argparse
import ast
import importlib.util
import inspect
import itertools
import pkgutil
import re
import tomllib
from pathlib import Path

import jax
import nibabel
import numpy as np
import OpenImageIO
import pages
import pytest
import typer.main
from pages import PAGES, ROOT

import jvr
from docs import reference
from jvr import cli
from jvr.cli.app import app
from jvr.integrators.slices.oracle import AbstractOracle
from jvr.io.config import build_fit, build_scene, config_from
from jvr.io.config.schema.parts import kinds_of, table_for
from jvr.march.differentiation import AbstractAdjoint
from jvr.march.quadrature import AbstractQuadrature
from jvr.model.camera import AbstractCamera
from jvr.model.effects import AbstractOcclusion, AbstractShading, AbstractShadows
from jvr.model.environment import EnvironmentLight
from jvr.model.environment_map import EnvironmentMap
from jvr.model.geometry import AbstractGeometry
from jvr.model.light import AbstractLight
from jvr.model.material import AbstractBRDF
from jvr.model.normals import AbstractNormals
from jvr.model.phase import AbstractPhase
from jvr.names import NAMES
from jvr.rendering.integrator import AbstractIntegrator
from jvr.rendering.pixel_filters import AbstractPixelFilter

PUBLIC = {name for names in NAMES.values() for name in names}
LANGUAGES = {"python", "sh", "toml", "math", "bibtex"}


def test_every_block_names_its_language():
    assert {block.language for block in pages.blocks()} <= LANGUAGES


def test_tables_are_read_as_tables():
    """A row that follows an empty line is text."""
    lines = {f"{page}:{t.map[0] + 1}" for page, text in PAGES.items() for t in pages.PARSER.parse(text) if t.content[:1] == "|"}
    assert lines == set()


def test_what_is_not_run_is_known():
    assert {block.place: block.not_run for block in pages.blocks() if block.not_run} == {}


# --- Python: each page is one program, on a small scan and in small pictures -----------------------------------------

# Pages whose code makes all that it uses, and what they have in place of large pictures.
WHOLE = {
    "README.md": {"width=256": "width=8", "height=256": "height=8", "30.0, 128, 128": "30.0, 6, 6", "entries=64": "entries=5"},
    "docs/environment_lighting.md": {"128, 128": "4, 4"},
}


def given() -> dict:
    """The names that the other pages take as given: a scene, cameras and their pictures."""
    volume = jvr.read_volume("head.nii.gz")
    scene = jvr.Scene(volume, jvr.presets.ct_bone())
    other_camera, *cameras = jvr.fibonacci_sphere(volume.center, 3 * volume.radius, 4, 30.0, 5, 5)
    other_image, *images = [jvr.render(scene, camera).rgb for camera in (other_camera, *cameras)]
    names = {"jax": jax, "jvr": jvr, "Path": Path, "volume": volume, "transfer": scene.transfer, "scene": scene}
    names |= {
        "camera": other_camera,
        "cameras": cameras,
        "images": images,
        "other_camera": other_camera,
        "other_image": other_image,
    }
    return names | {"start": jvr.Scene(volume, jvr.flat_transfer(volume, entries=4))}


@pytest.fixture
def desk(tmp_path, monkeypatch):
    """A folder with the files that the pages read: a scan of a head, and maps of light."""
    monkeypatch.chdir(tmp_path)
    distance = np.linalg.norm(np.indices((7, 8, 9)).T - [3.0, 3.5, 4.0], axis=-1).T
    scan = nibabel.Nifti1Image(np.round(1500 - 200 * distance).astype(np.int16), np.diag([3.0, 3.0, 3.0, 1.0]))
    scan.header.set_xyzt_units("mm")
    nibabel.save(scan, "head.nii.gz")
    for radiance, name in enumerate(("potsdamer_platz_1k", "studio_small_03_1k"), 1):
        OpenImageIO.ImageBuf(np.full((8, 16, 3), radiance, np.float32)).write(f"{name}.hdr")
    # Else the cores become devices of the whole process, which tests share.
    monkeypatch.setattr(jvr, "use_all_cores", lambda: None)


def pages_with(found: list[pages.Block], *slow: str) -> list:
    """The pages of these blocks; some of them, which take ten seconds, are for slow tests."""
    found_on = sorted({block.page for block in found} - {"CONTRIBUTING.md"})  # which `test_contributing.py` runs
    return [pytest.param(page, marks=[pytest.mark.slow] if page in slow else []) for page in found_on]


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    "page",
    pages_with(
        pages.blocks("python"),
        "README.md",
        "docs/environment_lighting.md",
        "docs/fitting.md",
        "docs/light.md",
        "docs/surfaces.md",
        "docs/voxels.md",
    ),
)
def test_code_runs(page, desk):
    smaller = dict(WHOLE.get(page, {}))
    names = {} if page in WHOLE else given()
    for block in pages.blocks("python"):
        if block.page == page and not block.not_run:
            code = block.code
            for text in [text for text in smaller if text in code]:
                code = code.replace(text, smaller.pop(text))
            # Lines of a traceback are those of the page.
            exec(compile("\n" * (block.line - 1) + code, page, "exec"), names)
    assert not smaller
    pictures = [np.asarray(shown.rgb) for shown in names.values() if isinstance(shown, jvr.Rendering)]
    assert all(np.all(np.isfinite(picture)) and np.ptp(picture) > 0.1 for picture in pictures)
    assert not any(np.array_equal(one, other) for one, other in itertools.combinations(pictures, 2))


# --- TOML: the tables of a page are one configuration, or the tables of a scene that was saved -----------------------

BASE = '[volume]\nbuiltin = "demo"\n[TRANSFER]\nkind = "window"\n'
SMALL = ("camera={width=2,height=2}", "settings.step=16")


def is_saved(block: pages.Block) -> bool:
    """Whether its kinds are names of classes, as in what `jvr.save_scene` writes."""
    return any(table.get("kind") in PUBLIC for table in tomllib.loads(block.code).values() if isinstance(table, dict))


@pytest.mark.parametrize("page", pages_with([b for b in pages.blocks("toml") if not is_saved(b)], "docs/files.md"))
def test_configurations_are_valid(page):
    text = "\n".join(block.code for block in pages.blocks("toml") if block.page == page and not is_saved(block))
    fits = "fit" in tomllib.loads(text)
    text += BASE.replace("TRANSFER", "truth" if fits else "transfer")
    config = lambda *sets: config_from(tomllib.loads(text), page, Path(), sets)
    if fits:
        build_fit(config(*SMALL, *(["lights.1.samples=1"] if "[[lights]]" in text else [])))
    else:
        build_scene(config())


@pytest.mark.parametrize("block", [b for b in pages.blocks("toml") if is_saved(b)], ids=lambda b: b.place)
def test_saved_scenes_are_valid(block, tmp_path):
    """Its tables in place of those of a scene that was saved."""
    transfer = jvr.LinearTransfer([0, 1], [[1, 1, 1], [1, 1, 1]], [0, 1])
    lit = {"lights": [jvr.PointLight([0, 0, 9])], "shading": jvr.Lambert()}
    jvr.save_scene(jvr.Scene(jvr.Volume(np.zeros((2, 2, 2))), transfer, **lit), tmp_path / "a.toml")
    tables = tomllib.loads(block.code)
    kept = re.split(r"\n(?=\[)", (tmp_path / "a.toml").read_text())
    kept = [text for text in kept if text.splitlines()[0].strip("[]") not in tables]
    (tmp_path / "a.toml").write_text("\n".join([*kept, block.code]))
    found = jvr.load_scene(tmp_path / "a.toml")
    assert {name: type(getattr(found, name)).__name__ for name in tables} == {
        name: table["kind"] for name, table in tables.items()
    }


FAMILIES = {
    "[[lights]]": AbstractLight,
    "[shading]": AbstractShading,
    "[shadows]": AbstractShadows,
    "[occlusion]": AbstractOcclusion,
    "[scattering.phase]": AbstractPhase,
    "[normals]": AbstractNormals,
    "[material]": AbstractBRDF,
    "[background]": EnvironmentMap,
    "[geometry]": AbstractGeometry,
    "[environment]": EnvironmentLight,
    "[camera]": AbstractCamera,
    "[settings.quadrature]": AbstractQuadrature,
    "[settings.adjoint]": AbstractAdjoint,
    "[settings.pixel_filter]": AbstractPixelFilter,
    "[settings.sampling]": AbstractIntegrator,
    "[settings.sampling.oracle]": AbstractOracle,
}


@pytest.mark.parametrize("section", FAMILIES)
def test_the_table_of_a_configuration_has_all_kinds_and_keys(section):
    family, names, keys, here = FAMILIES[section], set(), set(), False
    for line in PAGES["docs/files.md"].splitlines():
        first, *cells = line.strip("|").split(" | ") if line.startswith("|") else [""]
        here = section in first if first.strip() else here
        if here and len(cells) == 2 and (kinds := re.findall(r"`([\w-]+)`", cells[0])):
            names |= set(kinds)
            keys |= set(re.findall(r"`(\w+)`", cells[1]))
    tables = [table_for(family, kind) for kind in kinds_of(family)]
    assert names == set(kinds_of(family))
    assert keys - names == {key for table in tables for key in table.model_fields} - {"kind"} - names


# --- The reference ---------------------------------------------------------------------------------------------------


def test_the_reference_has_every_public_name():
    text = "\n".join(REFERENCE.values())
    for name in PUBLIC:
        assert re.search(rf"^:+{{py:\w+}} jvr\.{name}(?!\w)", text, re.MULTILINE), name
        assert getattr(jvr, name).__doc__, name
    assert "attenuation=None" in text
    assert "settings=Settings()" in text
    assert "py:function} jvr.sh.project(" in text
    assert "py:function} jvr.presets.ct()" in text
    assert "py:classmethod} look_at(eye, target, up, fov_y, width, height, *, near=None, far=None)" in text
    # Tables of functions and methods, and what configurations call them.
    orbit, disc = (text.split(head)[1].split("::::")[0] for head in ("jvr.orbit(", "classmethod} disc("))
    assert "| `axis` | x, y, z; what is up in every picture | (3,) | a direction of any length but zero | `(0, 0, 1)` |" in orbit
    assert "| `half_angle` | from the middle to the rim, in degrees | () | above 0 and at most 180 | needed |" in disc
    assert 'kind = "orbit"' in orbit
    assert 'kind = "disc"' in disc


# --- Commands: they parse, and the files and tests of this repository that they name are there -----------------------


class Parsed(Exception):
    """A command line was accepted."""


@pytest.fixture
def parsing(monkeypatch):
    """Programs end where they have parsed their command line."""
    whole = argparse.ArgumentParser.parse_args

    def parse(self, args=None, namespace=None):
        found = whole(self, args, namespace)
        if self.prog == "python -m benchmarks":
            return found  # it looks at the names of benchmarks itself
        raise Parsed

    def stop():
        raise Parsed

    monkeypatch.setattr(argparse.ArgumentParser, "parse_args", parse)
    monkeypatch.setattr(jvr, "use_all_cores", stop)

    def run(main, words):
        monkeypatch.setattr("sys.argv", words)
        with pytest.raises(Parsed):
            main()

    return run


COMMANDS = sorted({" ".join(words): (place, words) for place, words in pages.commands()}.values())


@pytest.mark.parametrize(("place", "words"), COMMANDS, ids=lambda value: value if isinstance(value, str) else "")
def test_commands_parse(place, words, parsing):
    program, *words = words
    if program == "jvr":
        command_of_jvr(words)
    elif program == "pip":
        command_of_pip(words)
    elif program == "make":
        assert re.search(rf"^{words[0]}:", (ROOT / "Makefile").read_text(), re.MULTILINE)
    elif program == "pytest":
        for file, *tests in (word.split("::") for word in words if word.endswith(".py") or "::" in word):
            assert all(f"def {test}(" in (ROOT / file).read_text() for test in tests)
    elif words[:2] == ["-m", "benchmarks"]:
        parsing(importlib.import_module("benchmarks.__main__").main, words[1:])
    elif words[0] == "-m":
        assert importlib.util.find_spec(words[1])
    else:
        parsing(importlib.import_module(words[0].removesuffix(".py").replace("/", ".")).main, words)


def test_cheap_commands_run(desk, capsys):
    lines = [words[1:] for _, words in pages.commands() if words[:2] == ["jvr", "info"] and len(words) > 2]
    assert lines
    assert all(cli.run(words) == 0 for words in lines)
    assert "7 x 8 x 9" in capsys.readouterr().out


def command_of_jvr(words):
    group = typer.main.get_command(app)
    if words[0].startswith("-"):
        assert words[0] in {name for parameter in group.params for name in parameter.opts}
        return
    command, rest = group.commands[words[0]], words[1:]
    if rest and rest[0].startswith("-") and any(parameter.param_type_name == "argument" for parameter in command.params):
        rest = ["FILE", *rest]  # sentences leave it out
    if rest:
        command.make_context(words[0], rest)


def command_of_pip(words):
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert {extra for word in words for names in re.findall(r"\[(.*)\]", word) for extra in names.split(",")} <= set(extras)


# --- Names: links, files, and what stands in code as a name of jvr ---------------------------------------------------


@pytest.mark.parametrize("page", PAGES)
def test_links_lead_to_files(page):
    for target in pages.links(PAGES[page]):
        if not re.match("https?:", target):
            file, _, heading = target.partition("#")
            linked = (ROOT / page).parent / file if file else ROOT / page
            assert linked.exists(), target
            assert not heading or heading in headings(linked.read_text(encoding="utf-8")), target


def headings(text: str) -> set[str]:
    """Anchors of a page, as GitHub makes them."""
    found = re.findall(r"^#+ (.+)$", text, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in found}


TEXTS = PAGES | pages.sources()
FILE = re.compile(r"(?<![\w/])(?:(?:jvr|docs|configs|experiments|benchmarks)/[\w./-]*\w|tests/[\w./-]+\.py(?:::\w+)?)")


@pytest.mark.parametrize("page", [page for page, text in TEXTS.items() if FILE.search(text)])
def test_files_that_are_named_exist(page):
    for named in FILE.findall(TEXTS[page]):
        file, _, test = named.partition("::")
        assert (ROOT / file).exists(), named
        assert f"def {test}(" in (ROOT / file).read_text() if test else True, named


def found(node: ast.expr):
    """What an expression in a page is a name of: `jvr.X.y`, `X.y` or `X` of a public `X`. `None` where it is none of jvr's."""
    if isinstance(node, ast.Attribute):
        owner = found(node.value)
        if owner is None or node.attr in getattr(owner, "__dataclass_fields__", {}):
            return None  # arrays of an object
        return getattr(owner, node.attr) if hasattr(owner, node.attr) else pkgutil.resolve_name(ast.unparse(node))
    name = node.id if isinstance(node, ast.Name) else None
    return jvr if name == "jvr" else getattr(jvr, name) if name in PUBLIC - {"fit"} else None


def expressions(page: str, text: str):
    """Every expression within the code of sentences, with the line of its paragraph."""
    for line, span in pages.spans(text):
        try:
            tree = ast.parse(span, mode="eval")
        except SyntaxError:
            continue
        yield from ((f"{page}:{line}: {ast.unparse(node)}", node) for node in ast.walk(tree))


REFERENCE = reference.pages()


@pytest.mark.parametrize("page", [page for page in (*PAGES, *REFERENCE) if page != "CHANGELOG.md"])
def test_names_and_arguments_exist(page):
    for place, node in expressions(page, (PAGES | REFERENCE)[page]):
        if isinstance(node, (ast.Attribute, ast.Name)):
            try:
                found(node)
            except (AttributeError, ImportError):
                pytest.fail(place)
        if isinstance(node, ast.Call) and (called := found(node.func)) is not None:
            check_arguments(place, node, inspect.signature(called))


def check_arguments(place: str, call: ast.Call, signature: inspect.Signature) -> None:
    """Keywords are parameters, and what stands for a parameter by its name stands at its place."""
    for keyword in call.keywords:
        assert keyword.arg in signature.parameters, f"{place}: {keyword.arg}"
    places = [p.name for p in signature.parameters.values() if p.kind is p.POSITIONAL_OR_KEYWORD and p.name != "self"]
    if any(isinstance(argument, ast.Constant) and argument.value is ... for argument in call.args):
        return
    assert len(call.args) <= len(places), place
    for argument, parameter in zip(call.args, places, strict=False):
        assert not isinstance(argument, ast.Name) or argument.id == parameter, f"{place}: {argument.id}"
