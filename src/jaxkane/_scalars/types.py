"""Shape aliases. Knows jaxtyping and nothing of mechanics."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, TypeAlias

from jaxtyping import Array, Float

if TYPE_CHECKING:
    Scalar: TypeAlias = Any  # numbers are given, arrays are kept: no checker follows the conversion
else:
    Scalar = Float[Array, ""]
    """A physical parameter: one float array without axes."""

Component: TypeAlias = Any
"""One component of a vector: a float array without axes, or an exact Python float."""

Triple: TypeAlias = tuple[Component, Component, Component]

Inputs: TypeAlias = Mapping[str, Any] | Callable[..., Any] | None
"""Inputs by name; those left out are zero."""
