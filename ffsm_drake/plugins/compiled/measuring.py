"""The sensors on symbols: the stages of ``systems.sensing.make_sensing``."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from ffsm_drake.plugins.equations.equations import quaternion_matrix
from ffsm_drake.systems.sensing import Sensor, quantize
from ffsm_drake.tape.arrays import traced


def measured(blocks: Any, cells: Any, known: Any) -> tuple[Any, Any, Any]:
    """Return the measurement of a known state [q; v], the truths of ``Sample.is_new`` (or None),
    and the measurements that late sensors keep after this sample.

    Args: the ``Blocks``, their cells, the state.
    """
    values, (along_white, along_others) = known, blocks.turned
    white = cells.deviation * cells.noise if blocks.noisy else 0.0
    if along_others and not along_white:  # isotropic noise is added in the world's axes
        values = values + white
    if along_white or along_others:
        values = _turned(values, known, back=False)
    if blocks.biased:
        attitude = cells.turn.reshape(4, 4) @ values[:4]
        values = np.concatenate([attitude, values[4:]]) + cells.bias
    if along_white or not along_others:
        values = values + white
    if blocks.drifting:
        values, entries = values.copy(), list(blocks.drifting)
        values[entries] = values[entries] + cells.drift
    if blocks.rounded:
        values = quantize(values, cells.resolution)
    if along_white or along_others:
        values = _turned(values, known, back=True)
    return _sampled(blocks.late, cells, values)


def _turned(values: Any, true: Any, *, back: bool) -> Any:
    """A measurement in the axes of the base's sensors, or ``back`` in the world's."""
    quaternion = true[:4] * (1.0 / np.sqrt(true[:4] @ true[:4]))
    w, x, y, z = quaternion
    turn = traced([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    R = traced(quaternion_matrix(list(quaternion)))
    values, nv = values.copy(), (len(values) - 1) // 2
    values[:4] = (turn if back else turn.T) @ values[:4]
    for first in (4, nv + 1, nv + 4):
        values[first : first + 3] = (R if back else R.T) @ values[first : first + 3]
    return values


def phases(late: tuple[Sensor, ...], samples: int) -> np.ndarray:
    """Return what ``Sensor.phase`` is at each sample, sensor after sensor (samples, 3 n)."""
    columns = [each for sensor in late for each in sensor.phase(np.arange(samples))]
    return np.array(columns, dtype=float).reshape(3 * len(late), samples).T


def _sampled(late: tuple[Sensor, ...], cells: Any, values: Any) -> tuple[Any, Any, Any]:
    """The stage ``systems.sensing.Sampling``."""
    shown, is_new = values.copy(), traced(np.ones(len(values), dtype=bool))
    kept, after = cells.past, [traced([])]
    for sensor, (measures, new, age) in zip(late, _phases(late, cells), strict=True):
        entries = list(sensor.entries)
        size = sensor.kept * len(entries)
        own, kept = kept[:size].reshape(sensor.kept, -1), kept[size:]
        for each in np.unique(sensor.phase(np.arange(sensor.period))[2]):
            if each >= 0:
                shown[entries] = np.where(age == each, own[each], shown[entries])
        is_new[entries] = new
        moved = np.concatenate([values[entries][None], own[:-1]])
        after.append(np.where(measures, moved, own).ravel())
    slow = any(sensor.period > 1 for sensor in late)
    return shown, is_new[1:] if slow else None, np.concatenate(after)


def _phases(late: tuple[Sensor, ...], cells: Any) -> Iterator[tuple[Any, Any, Any]]:
    """What ``Sensor.phase`` returns, of each sensor: numbers if it is the same at each sample."""
    for sensor, (measures, new, age) in zip(late, cells.phases.reshape(-1, 3), strict=True):
        is_alike = sensor.period == 1
        yield sensor.phase(0) if is_alike else (measures != 0.0, new != 0.0, age)
