"""Settings of all tests: float64, and no silent promotion of dtypes or shapes."""

import contextlib

import jax
import pytest

from jaxkane import _native

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")


@pytest.fixture(autouse=True, scope="module")
def _programs_are_forgotten():
    """Hundreds of compiled programs would fill the memory of a small machine."""
    yield
    jax.clear_caches()


@contextlib.contextmanager
def _switched(native):
    if native and _native.why_not():
        pytest.skip(f"no native kernels: {_native.why_not()}")
    was = _native.is_on()
    _native.use(native)
    yield
    _native.use(was)


@pytest.fixture(scope="module", params=["native", "XLA"])
def kernels(request):
    """A test once with native kernels, and once without."""
    with _switched(request.param == "native"):
        yield request.param


@pytest.fixture
def native():
    with _switched(True):
        yield


@pytest.fixture
def by_xla():
    with _switched(False):
        yield
