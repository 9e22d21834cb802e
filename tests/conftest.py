"""Strict JAX for every test: x64 is switched on per test by the `x64` fixture; rank promotion is an error."""

import os
import tempfile
from pathlib import Path

import jax
import numpy as np
import pytest

jax.config.update("jax_numpy_rank_promotion", "raise")


def pytest_configure(config):
    """What one file or worker compiles, the others of this run load. Workers find the folder in their environment."""
    if "JAX_COMPILATION_CACHE_DIR" in os.environ:
        return
    folder = tempfile.TemporaryDirectory(prefix="shapeenh-programs-")
    config.add_cleanup(folder.cleanup)
    for name, value in (
        ("jax_compilation_cache_dir", folder.name),
        ("jax_persistent_cache_min_compile_time_secs", 0.1),
    ):
        os.environ[name.upper()] = str(value)
        jax.config.update(name, value)


def pytest_addoption(parser):
    parser.addoption("--slow", action="store_true", help="run the tests marked slow too")
    parser.addoption("--thorough", action="store_true", help="run all there are: those marked slow and thorough too")


def pytest_collection_modifyitems(config, items):
    thorough = config.getoption("--thorough")
    for name, wanted in (("slow", config.getoption("--slow") or thorough), ("thorough", thorough)):
        for item in items:
            if name in item.keywords and not wanted:
                item.add_marker(pytest.mark.skip(reason=f"{name}; runs with --{name}"))


@pytest.fixture(params=["float32", "float64"])
def dtype(request):
    """Both precisions; float64 under jax_enable_x64."""
    with jax.enable_x64(request.param == "float64"):
        yield np.dtype(request.param)


@pytest.fixture
def x64():
    """float64, the reference precision."""
    with jax.enable_x64(True):
        yield np.dtype(np.float64)


@pytest.fixture(autouse=True, scope="module")
def forget_programs():
    """A run of all files would hold gigabytes of compiled programs; the next file loads what it needs of them again."""
    yield
    if _resident_bytes() > 2 << 30:
        jax.clear_caches()


def _resident_bytes() -> float:
    """Of this process; infinite where the system does not say."""
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except OSError:
        return float("inf")


@pytest.fixture
def rng():
    return np.random.default_rng(20090803)


@pytest.fixture
def compilations():
    """A list that grows by the name of every function that XLA compiles, `jit(f)`; clear it when warm."""
    names = []

    def listen(event, _, fun_name="", **__):
        if event == "/jax/core/compile/backend_compile_duration":
            names.append(fun_name)

    jax.monitoring.register_event_duration_secs_listener(listen)
    yield names
    jax.monitoring.unregister_event_duration_listener(listen)
