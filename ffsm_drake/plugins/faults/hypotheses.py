"""Hypotheses on the unit that is faulty, and the squares that each leaves of some features.

Of a joint: it stands still under a force of its own in each feature, of any size. Of a thruster:
its force is a share between the commanded and the full force, or between the commanded one and
none, the same share in all features. All features have the same payload.
"""

import dataclasses

import numpy as np

from ffsm_drake.plugins.faults.box_squares import least_squares
from ffsm_drake.plugins.faults.features import Features, rows_of
from ffsm_drake.spacecraft.coordinates import NUM_BASE_VELOCITIES

ALARM = 30.0  # squares of deviations that normal causes do not leave
MARGIN, RELATIVE = 14.0, 0.01  # by which a hypothesis is better: squares; share of those at hand
_MOST, _REST = 30.0, 0.03  # squares that a good hypothesis leaves: for a feature; share of all
_ANY = 1e3  # N m or N, any force of a jam
_NOTHING = 1e-3  # N, least force of a thruster's hypothesis; half width of what is no unknown
_TOP = 3  # features with the most evidence


@dataclasses.dataclass(frozen=True, kw_only=True)
class Hypotheses:
    """No fault, then joints, then thrusters with more and with less force than commanded."""

    joint: np.ndarray  # (h) index; -1: none
    thruster: np.ndarray  # (h) index; -1: none
    gives_more: np.ndarray  # (h)

    @classmethod
    def of(cls, joints: np.ndarray, thrusters: np.ndarray) -> "Hypotheses":
        """Args: indices of those in use."""
        twice, none = np.concatenate([thrusters, thrusters]), np.full(1, -1)
        one, two = np.full(len(joints), -1), np.full(len(twice), -1)
        more = np.repeat([False, True, False], [1 + len(joints), len(thrusters), len(thrusters)])
        return cls(
            joint=np.concatenate([none, joints, two]),
            thruster=np.concatenate([none, one, twice]),
            gives_more=more,
        )

    def of_places(self, which: np.ndarray) -> "Hypotheses":
        """Some of them."""
        return Hypotheses(
            joint=self.joint[which],
            thruster=self.thruster[which],
            gives_more=self.gives_more[which],
        )

    def units(self, joints: int) -> np.ndarray:
        """Indices of the units (h): thrusters after ``joints`` joints; -1: no fault."""
        return np.where(self.thruster >= 0, joints + self.thruster, self.joint)

    def signature(
        self, of: Features, force: np.ndarray, *, is_chain: bool = False
    ) -> tuple[np.ndarray, ...]:
        """W s of the unknowns (h, F, nv, F), and their lowest and highest values (h, F).

        Args: features; full forces (n), N; whether a thruster has a share in each feature, since
        the fault may begin between them.
        """
        count, nv = of.y.shape
        size = len(self.joint)
        matrix, high = np.zeros((size, count, nv, count)), np.full((size, count), _NOTHING)
        low = -high
        jams, each = np.flatnonzero(self.joint >= 0), np.arange(count)
        columns = of.white[:, :, NUM_BASE_VELOCITIES + self.joint[jams]]  # (F, nv, jams)
        for feature in each:
            matrix[jams, feature, :, feature] = columns[feature].T
        low[jams], high[jams] = -_ANY, _ANY
        valves = np.flatnonzero(self.thruster >= 0)
        index, more = self.thruster[valves], self.gives_more[valves]
        told = np.clip(of.told, 0.0, force)[:, index]
        missing = np.where(more, force[index] - told, -told)  # (F, valves), N
        along = np.einsum("fij,fjv->fiv", of.white, of.pushes[:, :, index])
        of_valves = (along * missing[:, None]).transpose(2, 0, 1)
        if is_chain:
            for feature in each:
                matrix[valves, feature, :, feature] = of_valves[:, feature]
            low[valves], high[valves] = 0.0, 1.0
        else:
            matrix[valves, :, :, 0] = of_valves
            low[valves, 0], high[valves, 0] = 0.0, 1.0
        return matrix, low, high

    def squares(
        self, of: Features, force: np.ndarray, *, is_chain: bool = False, enough: float = 0.0
    ) -> tuple[np.ndarray, np.ndarray]:
        """The least squares (h) that each leaves, or at most ``enough``, and its first unknown, a
        force or a share (h).
        """
        count, nv = of.y.shape
        own = of.matrix.shape[2] - nv
        wide = count * nv + own
        matrix = np.zeros((count, nv, wide))
        for feature in range(count):
            matrix[feature, :, feature * nv : (feature + 1) * nv] = of.matrix[feature, :, :nv]
        matrix[:, :, count * nv :] = of.matrix[:, :, nv:]
        low = np.concatenate([of.low[:, :nv].ravel(), of.low[0, nv:]])
        high = np.concatenate([of.high[:, :nv].ravel(), of.high[0, nv:]])
        signature, lowest, highest = self.signature(of, force, is_chain=is_chain)
        size = len(self.joint)
        whole = np.broadcast_to(matrix.reshape(1, count * nv, wide), (size, count * nv, wide))
        found, unknowns = least_squares(
            np.concatenate([whole, signature.reshape(size, count * nv, count)], axis=2),
            np.broadcast_to(of.y.reshape(1, -1), (size, count * nv)),
            np.hstack([np.broadcast_to(low, (size, wide)), lowest]),
            np.hstack([np.broadcast_to(high, (size, wide)), highest]),
            enough,
        )
        return found, unknowns[:, wide]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Vote:
    """What the features of a window say on each unit."""

    best: int  # unit that leaves the least squares
    gives_more: np.ndarray  # (units) whether a thruster gives too much, rather than too little
    share: np.ndarray  # (units) of its force that is missing or too much
    worse: np.ndarray  # (units) squares that each leaves beyond the best; infinite: not examined
    total: float  # squares without a fault


def vote(of: Features, squares: np.ndarray, force: np.ndarray, among: Hypotheses) -> Vote | None:
    """The vote of a window's features with evidence, if one hypothesis explains them.

    Hypotheses that one feature excludes are not solved for all.

    Args: features; the squares (F) that normal causes leave; full forces (n), N; hypotheses.
    """
    order = np.argsort(-squares, kind="stable")[:_TOP]
    order = order[squares[order] > ALARM]
    joints = of.y.shape[1] - NUM_BASE_VELOCITIES
    if not order.size:
        return None
    slope = np.flatnonzero(of.is_slope)
    stack = rows_of(of, np.concatenate([order, slope[~np.isin(slope, order)]]))
    left, _ = among.squares(rows_of(of, order[:1]), force)
    if left[1:].min(initial=np.inf) > max(_MOST * np.sqrt(len(stack.y)), _REST * squares.sum()):
        return None
    left = left.copy()
    known = np.zeros(len(left), dtype=bool)
    share = np.zeros(len(left))
    which = np.array([0, 1 + int(left[1:].argmin())])
    while which.size:
        left[which], share[which] = among.of_places(which).squares(stack, force)
        known[which] = True
        best = 1 + int(np.where(known, left, np.inf)[1:].argmin())
        room = MARGIN + RELATIVE * left[0]
        which = np.flatnonzero(~known & (left < left[best] + room))
    return _ranked(left, share, among, len(stack.y), (joints, len(force)))


def vote_of_chain(of: Features, force: np.ndarray, among: Hypotheses) -> Vote | None:
    """The vote of a chain of slopes, if one hypothesis explains them; arguments as ``vote``."""
    left, share = among.squares(of, force, is_chain=True)
    sizes = of.y.shape[1] - NUM_BASE_VELOCITIES, len(force)
    return _ranked(left, share, among, len(of.y), sizes)


def _ranked(
    left: np.ndarray, share: np.ndarray, among: Hypotheses, count: int, sizes: tuple[int, int]
) -> Vote | None:
    """The vote, if the best hypothesis is good.

    Args: squares and shares (h); hypotheses; numbers of features, and of joints and thrusters.
    """
    total, least = float(left[0]), float(left[1:].min())
    if least > max(_MOST * np.sqrt(count), _REST * total) or total - least < ALARM - 8.0:
        return None
    units = among.units(sizes[0])
    worse = np.full(sum(sizes), np.inf)
    np.minimum.at(worse, units[1:], np.maximum(left[1:] - least - RELATIVE * total, 0.0))
    gives_more, shares = np.zeros(worse.size, dtype=bool), np.zeros(worse.size)
    better = 1 + np.argsort(-left[1:], kind="stable")  # the last one stays
    gives_more[units[better]], shares[units[better]] = among.gives_more[better], share[better]
    best = 1 + int(left[1:].argmin())
    return Vote(
        best=int(units[best]), gives_more=gives_more, share=shares, worse=worse, total=total
    )
