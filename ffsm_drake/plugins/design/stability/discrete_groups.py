"""The discrete state of several Drake systems as a part of a vector."""

import numpy as np
from pydrake.systems.framework import Context, System

_Place = tuple[Context, int, slice]  # a discrete group


class Groups:
    """The discrete state of several systems as a part of a vector, with the slice of each group in
    ``parts``.
    """

    def __init__(self, systems: list[System], root: Context, *, first: int) -> None:
        """Args: the systems, the root context, and where the part begins."""
        self.parts, self._places = dict[tuple[System, int], slice](), list[_Place]()
        end, sizes = first, list[int]()
        for system in systems:
            context = system.GetMyMutableContextFromRoot(root)
            for group in range(context.num_discrete_state_groups()):
                sizes.append(context.get_discrete_state(group).size())
                own = slice(end, end + sizes[-1])
                self.parts[system, group], end = own, own.stop
                self._places.append((context, group, own))
        self._first, self.size = first, sum(sizes)
        self._owner = np.repeat(np.arange(len(sizes)), sizes)

    def read(self) -> np.ndarray:
        """The values."""
        found = np.empty(self.size)
        for context, group, own in self._places:
            found[own.start - self._first : own.stop - self._first] = context.get_discrete_state(
                group
            ).value()
        return found

    def write(self, values: np.ndarray, changed: np.ndarray) -> None:
        """Set the values of those groups that have changed entries."""
        own = changed[(changed >= self._first) & (changed < self._first + self.size)]
        for number in np.unique(self._owner[own - self._first]).tolist():
            context, group, part = self._places[number]
            context.SetDiscreteState(group, values[part])
