"""A memory of limited size. Knows Python."""

from __future__ import annotations

import threading
from typing import Any

MOST_REMEMBERED = 1000


class LRUCache(dict[Any, Any]):
    """A dict of at most `MOST_REMEMBERED` entries, of which the oldest go first. Threads may share it."""

    def __init__(self) -> None:
        super().__init__()
        self._lock = threading.Lock()

    def __setitem__(self, key: Any, value: Any) -> None:
        with self._lock:  # to look for the oldest is to iterate
            super().__setitem__(key, value)
            if len(self) > MOST_REMEMBERED:
                del self[next(iter(self))]
