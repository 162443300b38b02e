"""Faults of joints and thrusters: hypotheses on what the commands do not explain.

``features`` has what is seen, ``hypotheses`` what would explain it, and ``decision`` which unit is
reported.
"""

import operator
from collections.abc import Sequence

import numpy as np

from ffsm_drake.plugins.faults import features
from ffsm_drake.plugins.faults.box_squares import least_squares
from ffsm_drake.plugins.faults.decision import Found, decided
from ffsm_drake.plugins.faults.features import (
    CHAIN,
    LINKS,
    WINDOWS,
    Features,
    Means,
    Places,
    joined,
    rows_of,
)
from ffsm_drake.plugins.faults.hypotheses import ALARM, Hypotheses, Vote, vote, vote_of_chain
from ffsm_drake.plugins.faults.jam import JAMMED
from ffsm_drake.plugins.faults.known import CODE, SPAN, SUSPECTED
from ffsm_drake.plugins.faults.known import WINDOWS as SENSOR_WINDOWS
from ffsm_drake.plugins.faults.memory import Memory
from ffsm_drake.plugins.faults.panels import SIZE as PANELS
from ffsm_drake.plugins.faults.panels import SPANS, PanelBound
from ffsm_drake.plugins.faults.sensor_watch import SLOPE, SensorWatch, Slips
from ffsm_drake.plugins.faults.windows import BATCH, EVERY
from ffsm_drake.spacecraft.coordinates import NUM_BASE_VELOCITIES

_STILL, _NOISES = 2e-5, 6.0  # rad or m; deviations of noise that a joint at rest seems to move
_AT_REST = 3  # blocks
_PATIENCE, _BURST, _PERIOD = 60, 4, 20  # blocks with evidence; then so many of each period
_NOISE = 1e-9  # rad/s or m/s, least noise
_OFF = SENSOR_WINDOWS[:2]  # blocks of velocities that must agree with their positions


class MotionWatch(SensorWatch):
    """A fault of a joint or thruster is reported once all windows agree on it."""

    def _look_at_forces(self, memory: Memory, slips: Slips) -> None:
        """Report a fault that the last blocks show."""
        span = int(min(memory.span, SPAN))
        if span < 1:
            return
        panels = self._panels(memory, span) if self._is_flexible else None
        if span < features.FIRST:
            return
        # a velocity that differs from the slope of its position cannot reveal forces
        off, deviation = (of[: sum(each <= span for each in _OFF)] for of in slips)
        is_off = bool((np.abs(off) > SLOPE + 4.0 * deviation).any())
        was_off, memory.was_off = memory.was_off, float(is_off)
        if was_off or is_off:
            return
        if memory.tries > _PATIENCE and int(memory.clock) % _PERIOD >= _BURST:
            return
        votes = self._votes(memory, self._means(memory, span), panels)
        if span >= CHAIN * LINKS and (memory.tries or memory.clock % CHAIN == 0.0):
            votes = self._vote_of_chain(memory, votes)
        memory.tries = memory.tries + 1.0 if votes is not None else 0.0
        if votes and (found := decided(votes, memory, self._possible(memory), memory.clock)):
            self._report(memory, found)

    def _panels(self, memory: Memory, span: int) -> PanelBound:
        """The bound of the force of flexible parts, brought up to date."""
        panels = PanelBound(memory.grown, memory.grows)
        noise = np.maximum(self._velocity_noise, _NOISE) / np.sqrt(EVERY)
        left = memory.kept[-span:, self._at["left"]]
        if memory.clock % BATCH == 0.0:
            middles = self._at_middles(memory, np.minimum(SPANS, span) // 2)
            panels.update(left, middles[0], noise, EVERY * self._step)
        return panels

    def _at_middles(self, memory: Memory, ago: np.ndarray) -> tuple[np.ndarray, ...]:
        """``Models.at`` at the ends of the batches that are nearest to so many blocks ago."""
        nearest = np.maximum(np.round((memory.clock - ago) / BATCH), 1.0)
        back = np.minimum(nearest - memory.clock // BATCH, 0.0).astype(int)
        return self._models.at(memory.states[back - 1])

    def _slopes(self, memory: Memory, windows: Sequence[int], ago: Sequence[int]) -> Means:
        """Slopes over windows of blocks that ended so many blocks ago."""
        kept = memory.kept[-max(map(operator.add, windows, ago), default=1) :]
        left, errors, told = (kept[:, self._at[name]] for name in ("left", "errors", "impulse"))
        noise = np.maximum(self._velocity_noise, _NOISE) / np.sqrt(EVERY)
        return features.slopes(left, errors, told, noise, EVERY * self._step, windows, ago)

    def _means(self, memory: Memory, span: int) -> Means:
        """Slopes, then means that are weighted by forces."""
        windows = [each for each in WINDOWS if max(each, features.FIRST) <= span]
        slopes = self._slopes(memory, windows, [0] * len(windows))
        if not len(self._force):
            return slopes
        noise = np.maximum(self._velocity_noise, _NOISE)
        fired = features.fired(memory.pulses, span, self._force, noise, self._step)
        return joined([slopes, fired])

    def _places(self, memory: Memory, means: Means, panels: PanelBound | None) -> Places:
        """What the middles of windows tell."""
        _, inverse, bound, pushes = self._at_middles(memory, means.middle)
        if self._wrists.size:
            q = memory.states[-1, : self._nq]
            bound = bound + self._wrists.error(q, memory.pressed, means.spread)
        moved = memory.kept[:, self._at["moved"]]
        turns = np.abs(moved[-1 - means.ago] - moved[-means.window - means.ago])
        turns[:, 3:NUM_BASE_VELOCITIES] = 0.0
        of_panels = np.zeros((len(bound), PANELS))
        if panels is not None:
            pairs = zip(means.window.tolist(), means.is_slope.tolist(), strict=True)
            of_panels[:] = [panels.of(window, is_slope=is_slope) for window, is_slope in pairs]
        return Places(
            inverse=inverse, bound=bound, pushes=pushes, panels=of_panels,
            turned=turns.max(axis=1),
        )  # fmt: skip

    def _votes(
        self, memory: Memory, means: Means, panels: PanelBound | None
    ) -> dict[int, tuple[int, Vote]] | None:
        """Row of ``memory.against`` -> window and vote; None: there is no evidence."""
        places = self._places(memory, means, panels)
        is_free = np.zeros(len(means.window), dtype=bool)
        if panels is not None:
            # panels act on the base alone: a jam must show with any force on the base
            slope = np.flatnonzero(means.is_slope)
            rows = np.concatenate([np.arange(len(is_free)), slope])
            means, places = rows_of(means, rows), rows_of(places, rows)
            is_free = np.concatenate([is_free, np.ones(len(slope), dtype=bool)])
        all_of = features.whitened(means, places, self._box, is_free)
        squares, _ = least_squares(all_of.matrix, all_of.y, all_of.low, all_of.high, ALARM)
        if not (squares > ALARM).any():
            return None
        return self._votes_of(memory, all_of, squares)

    def _votes_of(
        self, memory: Memory, all_of: Features, squares: np.ndarray
    ) -> dict[int, tuple[int, Vote]]:
        """The votes of windows with evidence."""
        joints, thrusters = self._in_use(memory)
        votes = dict[int, tuple[int, Vote]]()
        for row in range(2 * len(WINDOWS)):
            window, is_free = WINDOWS[row // 2], bool(row % 2)
            which = (all_of.window == window) & (all_of.is_free == is_free)
            if not (squares[which] > ALARM).any():
                continue
            among = Hypotheses.of(joints, np.zeros(0, dtype=int) if is_free else thrusters)
            found = vote(rows_of(all_of, which), squares[which], self._force, among)
            is_joint = found is not None and found.best < len(self._joints)
            if found is None or (self._is_flexible and not is_free and is_joint):
                continue
            votes[row] = window, found
        return votes

    def _vote_of_chain(
        self, memory: Memory, votes: dict[int, tuple[int, Vote]] | None
    ) -> dict[int, tuple[int, Vote]] | None:
        """With the vote of slopes that follow one another: a payload that explains each of them
        may not explain all. Flexible parts are free to act on the base.
        """
        ago, is_free = [CHAIN * link for link in range(LINKS)], np.full(LINKS, self._is_flexible)
        means = self._slopes(memory, [CHAIN] * LINKS, ago)
        of = features.whitened(means, self._places(memory, means, None), self._box, is_free)
        joints, thrusters = self._in_use(memory)
        among = Hypotheses.of(joints, thrusters[: 0 if self._is_flexible else None])
        healthy = among.of_places(np.zeros(1, dtype=int))
        if healthy.squares(of, self._force, enough=ALARM)[0][0] <= ALARM:
            return votes
        found = vote_of_chain(of, self._force, among)
        return (votes or {}) | ({} if found is None else {2 * len(WINDOWS): (CHAIN, found)})

    def _in_use(self, memory: Memory) -> tuple[np.ndarray, np.ndarray]:
        """Indices of joints and thrusters without a known fault."""
        count = len(self._force)
        jammed = memory.codes[self._of_joints] > 0.0
        return np.flatnonzero(~jammed), np.flatnonzero(memory.codes[:count] == 0.0)

    def _possible(self, memory: Memory) -> np.ndarray:
        """Mask of the units: thrusters, and joints that stand still."""
        blocks = memory.kept[-_AT_REST:, self._at["moved"]][:, NUM_BASE_VELOCITIES:]
        noise = _NOISES * self._position_noise[NUM_BASE_VELOCITIES:] / np.sqrt(EVERY)
        stands = np.ptp(blocks, axis=0) < _STILL + noise
        return np.concatenate([stands, np.ones(len(self._force), dtype=bool)])

    def _report(self, memory: Memory, found: Found) -> None:
        """Report one unit, or those of which one is faulty."""
        count = len(self._joints)
        for unit in found.units:
            is_joint = unit < count
            name = f"joints.{self._joints[unit]}" if is_joint else self.units[unit - count]
            kind = JAMMED.name if is_joint else found.kind
            self._notice(memory, name, kind if len(found.units) == 1 else SUSPECTED)
        self._begin(memory)

    @staticmethod
    def _begin(memory: Memory) -> None:
        """Forget earlier looks."""
        for looks in (memory.against, memory.agreed, memory.doubted):
            looks[:] = 0.0
        memory.tries = 0.0

    def _notice(self, memory: Memory, unit: str, kind: str) -> None:
        index = self.units.index(unit)
        if memory.codes[index]:
            return
        memory.codes[index] = CODE[kind]
        self._forget(memory)
        is_without = self._base is not None and not unit.startswith("joints.")
        if is_without and self._base is not None:
            is_without = self._base.without(self._isolated(memory.codes))[2]
        if not is_without:
            memory.abort_request = 1.0
