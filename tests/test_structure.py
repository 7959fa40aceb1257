"""Who imports whom, what `import jvr` loads, and how often a rendering is traced."""

import ast
import importlib
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest
from scenes import OBLIQUE, affine, linear_transfer, lut_transfer, perspective, voxels

import jvr
from jvr.names import NAMES

PACKAGE = Path(jvr.__file__).parent
# A module imports from modules before it.
ORDER = (
    "names",
    "types",
    "numerics",
    "execution",
    "atomic",
    "pictures",
    "model",
    "march",
    "effects",
    "rendering",
    "integrators",
    "fitting",
    "io",
    "report",
    "cli",
)
# A constructor that reads a file imports its reader when it is called: the one thing that `model` takes from `io`.
READERS = {
    ("jvr.model.merl", "jvr.io.merl"),
    ("jvr.model.environment", "jvr.io.environment"),
    ("jvr.model.geometry", "jvr.io.geometry"),
}
HEAVY = (
    "optimistix",
    "jaxopt",
    "optax",
    "SimpleITK",
    "OpenEXR",
    "OpenImageIO",
    "skimage",
    "matplotlib",
    "typer",
    "rich",
    "pydantic",
    "pydicom",
    "tifffile",
    "imagecodecs",
    "PIL",
    "zarr",
)


def _imports(path, top_level_only=False):
    """Names of the modules of `jvr` that a file imports."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for node in tree.body if top_level_only else ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name.split(".")[0] == "jvr")
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            if node.module and node.module.split(".")[0] == "jvr":
                for alias in node.names:
                    name = f"{node.module}.{alias.name}"
                    yield name if _path(name) else node.module


def _path(module):
    """The file of a module, or `None` where the name is no module."""
    stem = PACKAGE.parent.joinpath(*module.split("."))
    return next((p for p in (stem.with_suffix(".py"), stem / "__init__.py") if p.is_file()), None)


def _modules():
    return {
        p: ".".join(p.relative_to(PACKAGE.parent).with_suffix("").parts).removesuffix(".__init__") for p in PACKAGE.rglob("*.py")
    }


def _part(module):
    return module.split(".")[1]


MODULES = {path: name for path, name in _modules().items() if name != "jvr"}


def test_the_order_names_every_part():
    assert {_part(name) for name in MODULES.values()} <= set(ORDER)


@pytest.mark.parametrize("path", MODULES, ids=lambda path: MODULES[path])
def test_a_module_imports_only_from_modules_before_it(path):
    own = ORDER.index(_part(MODULES[path]))
    at_the_top = set(_imports(path, top_level_only=True))
    for imported in _imports(path):
        if (MODULES[path], imported) in READERS:
            assert imported not in at_the_top, f"{MODULES[path]} imports {imported} before a file is read"
        elif imported != "jvr":
            assert ORDER.index(_part(imported)) <= own, f"{MODULES[path]} imports {imported}"
        else:
            assert _part(MODULES[path]) == "cli", f"{MODULES[path]} imports the public names"


def test_a_file_tells_one_story():
    lengths = {name: len(path.read_text(encoding="utf-8").splitlines()) for path, name in MODULES.items()}
    assert {name: n for name, n in lengths.items() if n > 400} == {}


def test_no_cycles():
    """Also not within a part, among imports at the top of files."""
    graph = {name: {i for i in _imports(path, top_level_only=True) if i != name} for path, name in MODULES.items()}
    done, open_ = set(), []

    def visit(name):
        assert name not in open_, " -> ".join([*open_[open_.index(name) :], name])
        if name not in done:
            open_.append(name)
            for other in sorted(graph.get(name, ())):
                visit(other)
            done.add(open_.pop())

    for name in graph:
        visit(name)


# Where the path of a module of integrators or effects stands: lists of what there is.
REGISTRY = {"jvr.names", "jvr.io.kinds", "jvr.io.exported"}


def test_an_integrators_module_is_named_by_registries_alone():
    named = {name for path, name in MODULES.items() if "jvr.integrators" in path.read_text(encoding="utf-8")}
    assert {name for name in named if _part(name) != "integrators"} == REGISTRY


def test_an_effects_module_is_named_by_registries_alone():
    """And by one line, what shows light."""
    texts = {name: path.read_text(encoding="utf-8") for path, name in MODULES.items() if _part(name) != "effects"}
    named = {name for name, text in texts.items() if "jvr.effects" in text}
    assert named - REGISTRY == {"jvr.rendering.medium"}
    assert texts["jvr.rendering.medium"].count("jvr.effects") == 1


def test_what_makes_pictures_and_fits_knows_no_integrator_by_name():
    """But for the one that is used by default."""
    homes = [home for home in NAMES if home.startswith(("jvr.integrators.", "jvr.rendering.marching"))]
    integrators = {name for home in homes for name in NAMES[home]}
    assert {"Uniform", "Refinement", "Slices", "LocalError"} <= integrators
    found = set()
    for path, module in MODULES.items():
        if _part(module) in ("execution", "model", "march", "effects", "rendering", "fitting"):
            tree = ast.walk(ast.parse(path.read_text(encoding="utf-8")))
            names = {getattr(node, "id", None) or getattr(node, "attr", None) or getattr(node, "name", None) for node in tree}
            found |= {(module, name) for name in names & integrators}
    assert found == {("jvr.rendering.marching", "Uniform"), ("jvr.rendering.settings", "Uniform")}


@pytest.mark.parametrize("module", ["jvr.march.oracle", "jvr.rendering.image", "jvr.rendering.sampling"])
def test_what_has_moved_is_found_where_it_was(module):
    """For one release, with a warning."""
    before = importlib.import_module(module)
    for name, new in before.MOVED.items():
        home, _, now = new.rpartition(".")
        with pytest.warns(DeprecationWarning, match=f"{module}.{name} is {new}"):
            assert getattr(before, name) is getattr(importlib.import_module(home), now)
    with pytest.raises(AttributeError, match="has no attribute 'nothing'"):
        _ = before.nothing


def test_import_is_light():
    code = f"import sys, jvr; print([m for m in {HEAVY} if m in sys.modules])"
    output = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert output.strip() == "[]"


def test_every_public_name_exists():
    """Names that load at first use, too."""
    for name in dir(jvr):
        assert getattr(jvr, name) is not None


def test_a_star_import_brings_every_public_name():
    """In a process that has loaded none of them yet."""
    code = "from jvr import *; import jvr; print(sorted({*jvr.__all__} - {*dir()}), len(jvr.__all__) > 100)"
    output = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert output.strip() == "[] True"


@pytest.mark.slow
def test_new_arrays_of_the_same_structure_are_not_traced_again():
    traces = []

    @jax.jit
    def render(scene, camera, settings):
        traces.append(settings)
        return jvr.render(scene, camera, settings).rgb

    volume = jvr.Volume(voxels(), OBLIQUE)
    first = render(jvr.Scene(volume, linear_transfer(), background=[0, 0, 0]), perspective(volume), jvr.Settings(0.5))
    other = jvr.Volume(voxels(seed=9), affine((2.0, 1.0, 0.7)), slope=2, intercept=-0.5)
    camera = perspective(other, direction=(-1.0, 0.2, 0.8), fov_y=25.0)
    second = render(jvr.Scene(other, linear_transfer(seed=9), background=[1, 1, 0.5]), camera, jvr.Settings(0.5))
    assert len(traces) == 1
    assert not np.allclose(first, second)
    # Another structure, another program.
    jax.eval_shape(render, jvr.Scene(volume, lut_transfer(), background=[0, 0, 0]), camera, jvr.Settings(0.5))
    jax.eval_shape(render, jvr.Scene(volume, linear_transfer()), camera, jvr.Settings(0.5))
    jax.eval_shape(render, jvr.Scene(volume, linear_transfer()), camera, jvr.Settings(0.25))
    assert len(traces) == 4


def test_what_a_scene_does_not_name_leaves_no_trace():
    """Without a background the program is not that of a black one."""
    volume = jvr.Volume(voxels(), OBLIQUE)
    camera = perspective(volume)
    program = lambda scene: str(jax.make_jaxpr(lambda s: jvr.render(s, camera).rgb)(scene))
    assert len(program(jvr.Scene(volume, linear_transfer()))) < len(
        program(jvr.Scene(volume, linear_transfer(), background=[0, 0, 0]))
    )
