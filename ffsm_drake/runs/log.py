"""The log of a run: its outcome, its time series and, with a capture, its grasp."""

import dataclasses
import functools
import itertools
from collections.abc import Mapping
from typing import Any

import numpy as np

from ffsm_drake.mission import OfMission
from ffsm_drake.runs.ending import Ending, Outcome, ending_of
from ffsm_drake.runs.engine import DRAKE
from ffsm_drake.runs.metrics import tracking_metrics
from ffsm_drake.runs.table import Given, Table, coordinate_columns
from ffsm_drake.runs.tracking import (
    FRAME_COORDINATES,
    FRAME_UNITS,
    Tracked,
    frame_poses,
    tracked_of,
)
from ffsm_drake.scenario import MassProperties
from ffsm_drake.spacecraft.coordinates import Coordinates, position_errors
from ffsm_drake.spacecraft.grasp import Contact
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.systems.controllers.law import ControlLaw
from ffsm_drake.systems.frame_path import goal_frame, tracked_rows
from ffsm_drake.systems.parts.metrics import Figure
from ffsm_drake.systems.parts.placed import Parts, figures_of, signals_of, with_role
from ffsm_drake.systems.parts.record import PartRecord, recorded
from ffsm_drake.systems.parts.signals import values_of


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class GraspLog:
    """The target before a run's grasp; world axes, SI units."""

    sample: int  # index of the first sample of the run at which the target is held
    # true mass properties of the target in frame P, where the model welds the payload body
    payload: MassProperties
    # legs before the grasp, in the order of the samples: name, number of samples
    legs: tuple[tuple[str, int], ...] = ()
    # (sample, 13) [quaternion, p_WP; w_WP, v_WP] of the target at the samples before
    target: np.ndarray
    contact: Contact | None = None  # None: the run ended before

    @property
    def phases(self) -> list[str]:
        """The leg of each sample before the grasp."""
        return [name for name, samples in self.legs for _ in range(samples)]

    def ledger(self, time: np.ndarray, coordinates: Coordinates) -> dict[str, Any] | None:
        """Return the grasp in plain numbers, where there was one; ``time`` (n; s) are the
        samples.
        """
        return None


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class RunLog(OfMission):
    """The time series of one run of a ``Rollout``. A ``RunRecord`` has more derived quantities.

    ``series`` has arrays (n, width) by name: the ``sources`` of the closed loop without
    ``estimated_state``. Control sample k used or produced the values at row k.

    Example:
      >>> from ffsm_drake import Rollout, load_scenario
      >>> scenario = load_scenario("postcapture", ["duration=0.1"])
      >>> log = Rollout(scenario).run(scenario)
      >>> log.time.shape, log.series["applied_force"].shape
      ((11,), (11, 11))
    """

    outcome: Outcome
    time: np.ndarray  # (n,), control samples t_k, s
    series: Mapping[str, np.ndarray]
    wall_time: dict[str, float]  # s: build (once for all runs), advance_to, total (of this run)
    grasp: GraspLog | None = None  # a run with a capture, unless it ended before
    parts: Parts = dataclasses.field(default_factory=dict)  # with signals and figures of their own
    # whether the controller tracks a frame, and coordinates only in its null space
    tracks_frame: bool = False
    sliding_unit: str = ControlLaw.sliding_unit
    engine: str = DRAKE  # name of what computed the run
    # the true plant; None: of the mission, flexible parts included
    own_model: PlantModel | None = None

    def __getitem__(self, name: str) -> np.ndarray:
        """Return a signal at the samples (n, its width), or (n) for a single number."""
        values = self.series.get(name)
        signal = next((each for each in signals_of(self.parts) if each.name == name), None)
        if signal is not None and signal.of is not None:
            values = values_of(signal, self)
        if values is None:
            raise KeyError(f"no signal '{name}'; there are: {', '.join(self.series)}")
        alone = values.ndim == 2 and values.shape[1] == 1
        return values[:, 0] if alone and not (signal and signal.components) else values

    def __contains__(self, name: str) -> bool:
        return name in self.series or any(each.name == name for each in signals_of(self.parts))

    @property
    def whole_states(self) -> np.ndarray:
        """[q; v] of the true plant (n, its size)."""
        return self.split.whole(self.series["state"], self.series.get("hidden_state"))

    @functools.cached_property
    def model(self) -> PlantModel:
        """The true plant, flexible parts included."""
        return self.own_model or self.mission.craft.flexible()

    @functools.cached_property
    def part_figures(self) -> dict[str, list[Figure]]:
        """Figures of the parts' metrics, by part. Raises BlockError if one fails."""
        return {name: list(figures_of(part, self)) for name, part in self.parts.items()}

    @property
    def figures(self) -> tuple[Figure, ...]:
        """Figures of all parts."""
        return tuple(itertools.chain(*self.part_figures.values()))

    @property
    def part_records(self) -> tuple[PartRecord, ...]:
        """The parts as a record stores them."""
        return tuple(
            recorded(self.parts[name], figures) for name, figures in self.part_figures.items()
        )

    def with_role(self, role: str) -> np.ndarray | None:
        """Return the sum of the signals with a role (n, 3); None without such signals."""
        names = with_role(self.parts, role)
        return sum(self[name] for name in names) if names else None  # type: ignore[return-value]

    @property
    def generalized_force(self) -> np.ndarray:
        """Control tau (n, nv), held from each sample to the next, N m or N."""
        return self.series["generalized_force"]

    @functools.cached_property
    def error(self) -> np.ndarray:
        """True tracking error e = q_d - q (n, nv), base rotation as a rotation vector in the world
        frame.
        """
        num_positions = len(self.coordinates.position_names)
        return position_errors(
            self.series["desired_state"][:, :num_positions], self.series["state"][:, :num_positions]
        )

    @functools.cached_property
    def frame_error(self) -> np.ndarray | None:
        """True pose error (n, 6), of FRAME_COORDINATES, of the frame in the scenario; NaN where the
        state is not ``usable``. Its reference is a path or follows the coordinates' plan; None if
        there is neither.
        """
        desired = self.series.get("desired_frame")
        if desired is None and not self.tracks_frame:
            return None
        model, num_positions = self.model, len(self.coordinates.position_names)
        q = self.whole_states[:, : model.plant.num_positions()]
        q_d = self.split.whole_positions(self.series["desired_state"][:, :num_positions])
        frame = goal_frame(self.scenario, model.plant)
        reference = frame_poses(model, q_d, frame) if desired is None else desired[:, :7]
        return position_errors(reference, frame_poses(model, q, frame))

    @functools.cached_property
    def table(self) -> Table:
        """Positions, velocities, errors and control forces, as metrics and endings read them."""
        scenario, coordinates = self.scenario, self.coordinates
        along, frame = ("time", "coordinate"), "frame_coordinate"
        states, split = self.series["state"], coordinates.num_positions
        columns: dict[str, Given] = {
            "position": (("time", "position_name"), states[:, :split]),
            "velocity": (along, states[:, split:]),
            "error": (along, self.error),
        }
        if "generalized_force" in self.series:  # a vector of environments keeps none
            columns["generalized_force"] = (along, self.generalized_force)
        coords = coordinate_columns(coordinates)
        coords["time"] = ("time", self.time, "control sample t_k", "s")
        if self.frame_error is not None:
            meaning = "true pose error of the frame (rotation vector, position; world)"
            columns["frame_error"] = (("time", frame), self.frame_error, meaning, "rad, m")
            prescribed = np.zeros(6, dtype=bool)
            # a frame that follows the coordinates' plan has a pose
            prescribed[tracked_rows(scenario)] = True
            coords |= {
                frame: (frame, FRAME_COORDINATES),
                "frame_unit": (frame, FRAME_UNITS),
                "frame_prescribed": (frame, prescribed),
                "frame_tracked": (frame, prescribed & self.tracks_frame),
            }
        attrs = {
            "title": scenario.description,
            "controller": scenario.controller,
            "sample_time": scenario.sample_time,
            "random_seed": scenario.random_seed,
        }
        return Table(attrs=attrs).assign(columns, coords)

    @functools.cached_property
    def tracked(self) -> Tracked:
        """The errors of the tracked coordinates and of a tracked frame."""
        return tracked_of(self.table)

    @functools.cached_property
    def ending(self) -> Ending:
        """The ending of the run: settled, not settled, growing, not captured, diverged,
        interrupted.
        """
        return ending_of(self.outcome, self.scenario, self.table, self)

    @property
    def metrics(self) -> dict[str, Any]:
        """Metrics, with the keys of ``ffsm_drake.runs.metrics.tracking_metrics``."""
        return tracking_metrics(self.table)
