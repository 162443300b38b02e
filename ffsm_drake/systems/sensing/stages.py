"""Stages of sensing in a row."""

import dataclasses
import itertools
from collections.abc import Sequence

from pydrake.systems.framework import DiagramBuilder, InputPort, OutputPort, System


@dataclasses.dataclass(frozen=True, kw_only=True)
class Row:
    """The ports of stages of sensing that are wired in a row."""

    inputs: tuple[InputPort, ...]  # ports of the true state
    estimated_state: OutputPort
    measurement_is_new: OutputPort | None  # port of the last stage with one


def wire_stages(builder: DiagramBuilder, stages: Sequence[System]) -> Row:
    """Wire stages, which the builder holds, in a row: each reads the estimate of the one before.

    A stage without the port ``measurement_is_new`` does not change what is new.
    """
    for before, after in itertools.pairwise(stages):
        builder.Connect(before.GetOutputPort("estimated_state"), after.GetInputPort("state"))
    true, new = "true_state", "measurement_is_new"
    timed: OutputPort | None = None
    for stage in stages:
        if timed is not None and stage.HasInputPort(new):
            builder.Connect(timed, stage.GetInputPort(new))
        if stage.HasOutputPort(new):
            timed = stage.GetOutputPort(new)
    others = [stage.GetInputPort(true) for stage in stages if stage.HasInputPort(true)]
    return Row(
        inputs=(stages[0].GetInputPort("state"), *others),
        estimated_state=stages[-1].GetOutputPort("estimated_state"),
        measurement_is_new=timed,
    )
