"""Results by key. The least recently used are freed. Does not depend on JAX.

A compiled program of a simulation takes about 100 memory mappings and 3 MB; with its derivative 400 mappings and 18 MB;
with contacts 1300 mappings and 50 MB. Linux terminates a process without a Python exception at 65 530 mappings. About
150 notebook cells reached this number, each of which defined a class again and differentiated its simulation. JAX keeps
every class of a pytree, so the end of a class cannot be detected. Its programs are therefore freed as the least
recently used.
"""

from __future__ import annotations

import collections
import gc
import itertools
import math
import threading
import warnings
import weakref
from collections.abc import Callable, Hashable, Iterable
from typing import Any, ClassVar

MISSING = object()
_MAPPINGS_OF_A_PROGRAM = 1400  # of a simulation with contacts; most programs have a tenth
_uses = itertools.count()


class Cache:
    """Results by key, shared by threads.

    size: the largest number of results. Beyond it, the least recently used are dropped.
    programs: whether the results contain compiled programs. Caches of programs are limited together, see `_Limit`.
    """

    _all: ClassVar[weakref.WeakSet[Cache]] = weakref.WeakSet()
    _all_lock = threading.Lock()

    def __init__(self, size: int = 256, programs: bool = False) -> None:
        self.size, self.programs = size, programs
        # result, weak references to its owners (to keep their callbacks alive), time of the last request
        self._entries: collections.OrderedDict[Hashable, tuple[Any, list[Any], int]] = collections.OrderedDict()
        self._lock = threading.RLock()  # comparing keys may run code that uses a cache
        # Callbacks of weak references run anywhere, also while this thread changes the dict. They only append here.
        self._ended: collections.deque[Hashable] = collections.deque()
        with Cache._all_lock:
            Cache._all.add(self)

    def get(self, key: Hashable, make: Callable[[], Any], owners: Iterable[Any] = ()) -> Any:
        """The result of a key. It is computed at the first call. If this raises an exception, nothing is kept."""
        result = self.known(key)
        return self.keep(key, make(), owners) if result is MISSING else result

    def known(self, key: Hashable, default: object = MISSING) -> Any:
        with self._lock:
            self._drop_ended()
            if key not in self._entries:
                return default
            result, references, _ = self._entries.pop(key)
            self._entries[key] = result, references, next(_uses)  # as the last one
            return result

    def keep(self, key: Hashable, result: object, owners: Iterable[Any] = ()) -> Any:
        """Keep a result until one of its `owners` ceases to exist. The `id` of an owner may be part of the key, because
        another object can have this `id` only afterwards."""
        if self.programs:
            LIMIT.check(hash(key))
        ended = self._ended
        references = [weakref.ref(x, lambda _: ended.append(key)) for x in owners]
        with self._lock:
            self._drop_ended()
            self._entries.pop(key, None)
            self._entries[key] = result, references, next(_uses)
            if len(self._entries) > self.size:
                self._entries.popitem(last=False)
        return result

    def _drop_ended(self) -> None:
        while self._ended:
            self._entries.pop(self._ended.popleft(), None)

    def __len__(self) -> int:
        with self._lock:
            self._drop_ended()
            return len(self._entries)

    def clear(self) -> None:
        with self._lock:
            self._entries.clear()

    @classmethod
    def all(cls) -> list[Cache]:
        with cls._all_lock:
            return list(cls._all)

    def uses(self) -> list[int]:
        """The times of the last request of each result."""
        with self._lock:
            return [used for *_, used in self._entries.values()]

    def drop(self, last_use: int) -> list[Hashable]:
        """Drop the results that were not requested after `last_use`. **Returns:** their keys."""
        with self._lock:
            dropped = {key: entry for key, entry in self._entries.items() if entry[-1] <= last_use}
            for key in dropped:
                del self._entries[key]
        return [*dropped]  # the programs are freed outside of the lock


def owners_of(x: object) -> list[Any]:
    """The object itself, as the owner of a result. Empty if the object does not support weak references."""
    try:
        weakref.ref(x)
    except TypeError:
        return []
    return [x]


def memory_mappings() -> tuple[int, int]:
    """The number of mappings of this process, and the limit of Linux. (0, 1) on systems without this limit."""
    try:
        with open("/proc/self/maps", "rb") as used, open("/proc/sys/vm/max_map_count", "rb") as most:
            return used.read().count(b"\n"), int(most.read())
    except (OSError, ValueError):
        return 0, 1


class _Limit:
    """Frees the least recently used programs of all caches if this process has too many memory mappings.

    mappings: beyond this number, a quarter of the programs is dropped, or more if necessary. The number doubles, up to
        half of the limit of Linux, when a dropped program is requested again. Otherwise, alternating between many
        models would recompile them every time. It also doubles if the mappings belong to other code.
    dropped: hashes of the keys of programs that were dropped since.
    """

    def __init__(self, mappings: int = 4000) -> None:
        self.mappings, self.has_warned = mappings, False
        self.dropped: set[int] = set()
        self._expected: float = math.inf  # mappings now, if all programs since the last reading are large
        self._lock = threading.Lock()

    def check(self, new: int) -> None:
        """`new`: the hash of the key of a program that will be compiled."""
        self._expected += _MAPPINGS_OF_A_PROGRAM
        # To list 4000 mappings takes 10 ms or more, so they are read only if the limit may have been reached.
        is_far = self._expected <= self.mappings and new not in self.dropped
        if is_far or not self._lock.acquire(blocking=False):  # another thread runs this check
            return
        try:
            used, most = memory_mappings()
            if new in self.dropped:
                self._double(most)
            if used > self.mappings:
                used = self._drop(most)
            self._expected = used + _MAPPINGS_OF_A_PROGRAM
            if used > 0.75 * most and not self.has_warned:
                self.has_warned = True
                warnings.warn(
                    f"This process has {used} memory mappings, and Linux terminates it at {most}. Compiled programs "
                    "use them. Call jaxkane.forget(), which also frees those of jax.jit, or restart the process.",
                    stacklevel=2,
                )
        finally:
            self._lock.release()

    def _double(self, most: int) -> None:
        self.mappings = max(self.mappings, min(2 * self.mappings, most // 2))
        self.dropped.clear()

    def _drop(self, most: int) -> int:
        """**Returns:** the number of mappings afterwards."""
        caches = [cache for cache in Cache.all() if cache.programs]
        for fraction in (0.25, 0.5, 1.0):
            uses = sorted(use for cache in caches for use in cache.uses())
            for cache in caches if uses else ():
                self.dropped.update(map(hash, cache.drop(uses[int(fraction * (len(uses) - 1))])))
            gc.collect()  # programs may be in reference cycles
            if (used := memory_mappings()[0]) <= self.mappings:
                return used
        self._double(most)
        return used


LIMIT = _Limit()
