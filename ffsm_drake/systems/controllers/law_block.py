"""A control law as a block: from measurement and reference to force."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from ffsm_drake.spacecraft.coordinates import Coordinates, tracking_errors
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.systems.controllers.checked import Step
from ffsm_drake.systems.controllers.law import Sample, State
from ffsm_drake.systems.frame_path import FRAME_SIZE
from ffsm_drake.systems.sampled import Now, Sampled

REQUIRED = ("estimated_state", "desired_state", "desired_acceleration")  # inputs
Errors = Callable[[Any, Any, int], tuple[Any, Any]]


class LawBlock(Sampled):
    """A control law as a ``Sampled`` block, for ``SampledController`` or on symbols.

    The law sees no error of undriven coordinates, and commands no force on them.
    """

    def __init__(
        self,
        law: Any,
        coordinates: Coordinates,
        *,
        errors: Errors = tracking_errors,
        step: Step | None = None,
    ) -> None:
        """Args: a law for the coordinates; what computes tracking errors, unless its model does;
        its ``checked_step``, by default its own.
        """
        self.law, self._num_positions = law, len(coordinates.position_names)
        self._size = len(coordinates.names)
        self._undriven = np.flatnonzero(~coordinates.is_driven) if coordinates.undriven else None
        model = getattr(law, "model", None)
        self._errors = model.calc_tracking_errors if isinstance(model, PlantModel) else errors
        self._step = step or (lambda sample, memory, time: law.step(sample, memory))

    @property
    def inputs(self) -> Mapping[str, int]:
        """See Sampled; those that are optional are described at SampledController."""
        nv, nx = self._size, self._num_positions + self._size
        contacts = getattr(self.law, "contacts_read", 0)
        sizes = {
            "estimated_state": nx, "desired_state": nx, "desired_acceleration": nv,
            "applied_force": nv, "measurement_is_new": nx,
            "desired_frame": FRAME_SIZE * bool(getattr(self.law, "tracks_frame", False)),
            "measured_wrench": 6 * contacts,
        }  # fmt: skip
        return {name: size for name, size in sizes.items() if size}

    @property
    def outputs(self) -> Mapping[str, int]:
        """See Sampled."""
        return {"generalized_force": self._size}

    def start(self, state: np.ndarray | None = None) -> State:
        """See Sampled."""
        return self.law.initial_state()

    def step(self, inputs: State, memory: State, now: Now) -> tuple[State, State]:
        """See Sampled."""
        force, memory = self._step(self._sample(inputs, is_first=now.is_first), memory, now.time)
        return {"generalized_force": self._driven(force)}, memory

    def _sample(self, inputs: State, *, is_first: bool) -> Sample:
        """What the law reads, from the inputs by name."""
        split, estimated, desired = (
            self._num_positions, inputs["estimated_state"], inputs["desired_state"],
        )  # fmt: skip
        e, e_dot = self._errors(desired, estimated, split)
        if self._undriven is not None:
            e[..., self._undriven] = e_dot[..., self._undriven] = 0.0
        is_new = inputs.get("measurement_is_new")
        return Sample(
            estimated[..., :split],
            estimated[..., split:],
            desired[..., :split],
            desired[..., split:],
            inputs["desired_acceleration"],
            e,
            e_dot,
            inputs["applied_force"],
            is_first,
            # The quaternion has one entry more than the rotation vector.
            None if is_new is None else is_new[..., 1:] != 0.0,
            inputs.get("desired_frame"),
            inputs.get("measured_wrench"),
        )

    def _driven(self, force: Any) -> Any:
        """A law's force, without those on undriven coordinates."""
        if self._undriven is not None:
            force = force.copy()
            force[..., self._undriven] = 0.0
        return force
