"""Shapes and types that the annotations of `jvr` claim are checked at run time in every test."""

import collections
import gc
import os
from importlib import metadata
from pathlib import Path

os.environ.setdefault("JAX_ENABLE_COMPILATION_CACHE", "false")
# The rest goes into traces: a tenth of it into saying in each program which line of Python an operation comes from, and a sixth into
# looking for garbage among millions of objects that are none.
os.environ.setdefault("JAX_TRACEBACK_IN_LOCATIONS_LIMIT", "0")
gc.set_threshold(200_000, 10, 10)
# Most of the time goes into compiling programs that run for a moment: a quarter of it without what makes them fast.
# A third of what remains goes into loops that the compiler copies for each kernel that they are fused into, unless it does so at the end.
CHEAP = "--xla_backend_optimization_level=0 --xla_backend_extra_options=xla_cpu_flatten_after_fusion=1"
if tuple(map(int, metadata.version("jaxlib").split(".")[:2])) < (0, 11):
    # Later compilers do not know these flags, and a flag that is not known ends the process.
    CHEAP += " --xla_cpu_use_fusion_emitters=false --xla_cpu_parallel_codegen_split_count=1"
os.environ["XLA_FLAGS"] = f"{CHEAP} {os.environ.get('XLA_FLAGS', '')}".strip()

from jaxtyping import install_import_hook

_hook = install_import_hook("jvr", "beartype.beartype")
_hook.__enter__()

import jax
import pytest

if "JVR_TEST_DEVICES" in os.environ:
    jax.config.update("jax_num_cpu_devices", int(os.environ["JVR_TEST_DEVICES"]))

MANY_MAPS = 12_000
DATA = Path(os.environ.get("JVR_DATA", Path(__file__).parents[2] / "shared" / "data"))


def pytest_collection_modifyitems(items):
    """Files with the most slow tests come first: processes that share files are done at the same time when the last ones are short."""
    slow = collections.Counter(item.path for item in items if item.get_closest_marker("slow"))
    items.sort(key=lambda item: -slow[item.path])


def pytest_collection_finish():
    """What imports have made stays, and need not be looked at for garbage."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="module", autouse=True)
def _programs_go():
    """Compiled programs are let go after a file where there are many: a process may hold 65,530 maps of memory, and each takes several."""
    yield
    maps = Path("/proc/self/maps")
    if not maps.exists() or maps.read_bytes().count(b"\n") > MANY_MAPS:
        jax.clear_caches()
        gc.collect()


@pytest.fixture(scope="module")
def _registry():
    """Classes that are registered by the tests of a file are known to them, and not to others."""
    from jvr.io.kinds import KINDS, PARTS

    known = dict(PARTS), {family: dict(kinds) for family, kinds in KINDS.items()}
    yield
    for here, before in zip((PARTS, KINDS), known, strict=True):
        here.clear()
        here.update(before)


@pytest.fixture
def x64():
    """Double precision for one test."""
    with jax.enable_x64(True):
        yield


@pytest.fixture
def data() -> Path:
    """The folder of public volumes; a test that needs it is skipped, with the reason, where it is absent."""
    if not DATA.is_dir():
        pytest.skip(f"needs the public volumes, not found in {DATA}: set JVR_DATA to their folder")
    return DATA
