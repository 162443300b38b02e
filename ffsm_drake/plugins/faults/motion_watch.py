"""Faults of joints and thrusters: hypotheses on what the commands do not explain.

``features`` has what is seen, ``hypotheses`` what would explain it, and ``decision`` which unit is
reported.
"""

import numpy as np

from ffsm_drake.plugins.faults import features
from ffsm_drake.plugins.faults.box_squares import least_squares
from ffsm_drake.plugins.faults.decision import Found, decided
from ffsm_drake.plugins.faults.features import WINDOWS, Features, Means, Places
from ffsm_drake.plugins.faults.hypotheses import ALARM, Hypotheses, Vote, vote
from ffsm_drake.plugins.faults.jam import JAMMED
from ffsm_drake.plugins.faults.known import CODE, EVERY, SPAN, SUSPECTED, Memory
from ffsm_drake.plugins.faults.panels import SIZE as PANELS
from ffsm_drake.plugins.faults.panels import PanelBound
from ffsm_drake.plugins.faults.payload_error import place
from ffsm_drake.plugins.faults.sensor_watch import SensorWatch
from ffsm_drake.spacecraft.coordinates import NUM_BASE_VELOCITIES

_STILL, _NOISES = 2e-5, 6.0  # rad or m; deviations of noise that a joint at rest seems to move
_AT_REST = 3  # blocks
_FIRST = 13  # blocks
_PATIENCE, _BURST, _PERIOD = 60, 4, 20  # blocks with evidence; then so many of each period
_NOISE = 1e-9  # rad/s or m/s, least noise
_OFF = (8, 24)  # blocks


class MotionWatch(SensorWatch):
    """A fault of a joint or thruster is reported once all windows agree on it."""

    def _collect_fired(self, memory: Memory, left: np.ndarray, expected: np.ndarray) -> None:
        """Add a sample to the sums weighted by the commanded forces."""
        count = len(self._force)
        if not count:
            return
        told, before = memory.told[:count], memory.fires
        seen = np.concatenate([told, left / self._step, expected / self._step, [1.0]])
        changes = (told - before) ** 2
        memory.firing += np.column_stack([np.outer(told, seen), changes]).ravel()
        memory.fires = told.copy()

    def _end_block(self, memory: Memory) -> None:
        """Keep the sums and the model's matrices of a block."""
        memory.fired = np.vstack([memory.fired[1:], memory.firing])
        memory.firing = np.zeros_like(memory.firing)
        memory.span += 1.0
        memory.clock += 1.0
        state = memory.seen
        mass = np.array(self._model.calc_mass_matrix(state[: self._nq]))
        payload = np.zeros(6 * self._nv + 15)
        if self._is_loaded:
            payload = place(self._model, *self._payload, state)
        bound = self._bounds.of_force(mass, state)
        row = np.concatenate([mass.ravel(), bound, self._pushes(state).ravel(), payload])
        memory.frames = np.vstack([memory.frames[1:], row])

    def _look_at_forces(self, memory: Memory) -> None:
        """Report a fault that the last blocks show."""
        span = int(min(memory.span, SPAN))
        panels = self._panels(memory, span) if self._is_flexible else None
        if span < _FIRST:
            return
        was_off, memory.was_off = memory.was_off, float(self._are_any_off(memory, span))
        if was_off or memory.was_off:
            return
        if memory.tries > _PATIENCE and int(memory.clock) % _PERIOD >= _BURST:
            return
        votes = self._votes(memory, self._means(memory, span), panels)
        memory.tries = memory.tries + 1.0 if votes is not None else 0.0
        if votes and (found := decided(votes, memory, self._possible(memory), memory.clock)):
            self._report(memory, found)

    def _are_any_off(self, memory: Memory, span: int) -> bool:
        """Whether a velocity differs from the slope of its position."""
        counts = [each for each in _OFF if each <= span]
        return any(self._are_velocities_off(memory, memory.kept[-each:]) for each in counts)

    def _panels(self, memory: Memory, span: int) -> PanelBound:
        """The bound of the force of flexible parts, brought up to date."""
        panels, nv = PanelBound(memory.grown, memory.grows), self._nv
        noise = np.maximum(self._velocity_noise, _NOISE) / np.sqrt(EVERY)
        left = memory.kept[-span:, self._at["left"]]
        mass = memory.frames[-span:, : nv * nv].reshape(-1, nv, nv)
        panels.update(left, mass, noise, EVERY * self._step)
        return panels

    def _means(self, memory: Memory, span: int) -> list[Means]:
        """Slopes, then means that are weighted by forces."""
        kept, count = memory.kept[-span:], len(self._force)
        noise = np.maximum(self._velocity_noise, _NOISE)
        left, velocity, impulse = (
            kept[:, self._at[name]] for name in ("left", "velocity", "impulse")
        )
        of_block = noise / np.sqrt(EVERY)
        found = [features.slopes(left, velocity, impulse, of_block, EVERY * self._step)]
        if count:
            sums = memory.fired[-span:].reshape(span, count, -1)
            found.append(features.fired(sums, self._force, noise, self._step))
        return found

    def _frames(self, memory: Memory, means: list[Means]) -> list[Places]:
        """What the middles of windows tell."""
        nv, count, found = self._nv, len(self._force), list[Places]()
        ends = np.cumsum([nv * nv, nv, nv * count])
        moved = memory.kept[:, self._at["moved"]]
        turns = np.delete(np.arange(nv), [3, 4, 5])
        for each in means:
            mass, bound, pushes, payload = np.split(memory.frames[-1 - each.middle], ends, axis=1)
            of_places = Places(
                mass=mass.reshape(-1, nv, nv),
                bound=bound,
                velocity=memory.kept[-1 - each.middle][:, self._at["velocity"]],
                payload=payload[:, : payload.shape[1] * self._is_loaded],
                pushes=pushes.reshape(len(pushes), nv, count),
                panels=np.zeros((len(mass), PANELS)),
                turned=np.abs(moved[-1] - moved[-each.window])[:, turns].max(axis=1, initial=0.0),
            )
            found.append(of_places)
        return found

    def _votes(
        self, memory: Memory, means: list[Means], panels: PanelBound | None
    ) -> dict[int, tuple[int, Vote]] | None:
        """Row of ``memory.against`` -> window and vote; None: there is no evidence."""
        made = list[Features]()
        for each, at in zip(means, self._frames(memory, means), strict=True):
            if panels is not None:
                for row, window in enumerate(each.window):
                    of_panels = panels.of(int(window), is_slope=bool(each.is_slope[row]))
                    at.panels[row] = of_panels
            if len(each.window):
                made.append(features.whitened(each, at, self._box, is_free=False))
                # panels act on the base alone: a jam must show with any force on the base
                if panels is not None and each.is_slope[0]:
                    made.append(features.whitened(each, at, self._box, is_free=True))
        all_of = features.joined(*made)
        errors = memory.errors[: all_of.matrix.shape[2] - self._nv]
        # payloads that explained what was seen before: the nominal one, the last one
        squares = np.minimum(all_of.at_most(0.0 * errors), all_of.at_most(errors))
        looks = np.flatnonzero(squares > ALARM)
        if not looks.size:
            return None
        of = all_of.of(looks)
        squares[looks], unknowns = least_squares(of.matrix, of.y, of.low, of.high)
        if not (squares > ALARM).any():
            memory.errors[: errors.size] = unknowns[squares[looks].argmax(), self._nv :]
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
            found = vote(all_of.of(which), squares[which], self._force, among)
            is_joint = found is not None and found.best < len(self._joints)
            if found is None or (self._is_flexible and not is_free and is_joint):
                continue
            votes[row] = window, found
        return votes

    def _in_use(self, memory: Memory) -> tuple[np.ndarray, np.ndarray]:
        """Indices of joints and thrusters without a known fault."""
        count = len(self._force)
        jammed = self._jammed(memory.codes)[NUM_BASE_VELOCITIES:]
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
            name = f"joints.{self._joints[unit]}" if is_joint else self._names[unit - count]
            kind = JAMMED.name if is_joint else found.kind
            self._notice(memory, name, kind if len(found.units) == 1 else SUSPECTED)
        self._begin(memory)

    @staticmethod
    def _begin(memory: Memory) -> None:
        """Forget earlier looks."""
        for looks in (memory.against, memory.agreed, memory.doubted, memory.errors):
            looks[:] = 0.0
        memory.tries = 0.0

    def _notice(self, memory: Memory, unit: str, kind: str) -> None:
        index = self._names.index(unit)
        if memory.codes[index]:
            return
        memory.codes[index] = CODE[kind]
        self._forget(memory)
        is_without = self._base is not None and not unit.startswith("joints.")
        if is_without and self._base is not None:
            is_without = self._base.without(self._isolated(memory.codes))[2]
        if not is_without:
            memory.abort_request = 1.0
