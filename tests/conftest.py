"""Settings of all tests: float64, and no silent promotion of dtypes or shapes."""

import jax
import pytest

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")


@pytest.fixture(autouse=True, scope="module")
def _programs_are_forgotten():
    """Hundreds of compiled programs would fill the memory of a small machine."""
    yield
    jax.clear_caches()
