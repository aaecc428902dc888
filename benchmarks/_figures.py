"""What a part of the suite hands back: figures, with the target of each beside it."""

from __future__ import annotations

import dataclasses


@dataclasses.dataclass(frozen=True)
class Figure:
    """One measured number.

    `what` is the row of the table, `column` "XLA", "native" or "" for both; `unit` "x" marks a ratio. At most one of
    `at_most` and `at_least` is the target that it is held against.
    """

    part: str
    what: str
    value: float
    unit: str = "x"
    column: str = ""
    at_most: float | None = None
    at_least: float | None = None

    @property
    def met(self) -> bool | None:
        """Whether the target is met; None without one."""
        if self.at_most is not None:
            return self.value <= self.at_most
        return None if self.at_least is None else self.value >= self.at_least

    @property
    def target(self) -> str:
        if self.at_most is not None:
            return f"at most {self.at_most:g}"
        return "" if self.at_least is None else f"at least {self.at_least:g}"

    def __str__(self) -> str:
        return f"{digits(self.value)} {_UNITS.get(self.unit, self.unit)}".strip()


_UNITS = {"x": "", "rides/s": "rides a second", "walks/s": "walks a second"}


def digits(x: float) -> str:
    """Three digits, without an exponent where that reads well."""
    if x == 0 or not 1e-3 <= abs(x) < 1e6:
        return f"{x:.2e}"
    return f"{x:.0f}" if abs(x) >= 100 else f"{x:.3g}"


def line(figure: Figure) -> str:
    """As it is printed while the suite runs."""
    verdict = {True: "met", False: "not met", None: ""}[figure.met]
    told = f"{figure.target}: {verdict}" if figure.target else ""
    return f"  {figure.what:74s}{figure.column:8s}{figure!s:>22s}   {told}".rstrip()
