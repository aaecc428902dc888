"""A memory of limited size. Knows Python."""

from __future__ import annotations

from typing import Any

MOST_REMEMBERED = 1000


class Memory(dict[Any, Any]):
    """A dict of at most `MOST_REMEMBERED` entries, of which the oldest go first. Threads may share it."""

    def __setitem__(self, key: Any, value: Any) -> None:
        super().__setitem__(key, value)
        if len(self) > MOST_REMEMBERED:
            self.pop(next(iter(self)), None)
