"""Values that take long to make, kept for a while."""

import collections
from collections.abc import Hashable
from typing import Generic, TypeVar

Value = TypeVar("Value")


class Recent(Generic[Value]):
    """The values that were used last, by key."""

    def __init__(self, most: int) -> None:
        """Args: the most values that are kept."""
        self._most = most
        self._kept: collections.OrderedDict[Hashable, Value] = collections.OrderedDict()

    def get(self, key: Hashable) -> Value | None:
        """Return the value of a key; None: it is not kept."""
        if key not in self._kept:
            return None
        self._kept.move_to_end(key)
        return self._kept[key]

    def keep(self, key: Hashable, value: Value) -> Value:
        """Keep a value, and forget the one that was used longest ago. Return the value."""
        self._kept[key] = value
        self._kept.move_to_end(key)
        if len(self._kept) > self._most:
            self._kept.popitem(last=False)
        return value
