"""Whether a healthy spacecraft could have given what a record of ``fault_records.py`` shows.

    python benchmarks/healthy_twins.py out/fed/faulty_004.npz

The measured velocities from the fault on are fitted with the nominal model, a disturbance within
its bounds that is constant over 0.05 s, and one payload within its intervals. A *healthy twin* is a
fit that leaves at most one noise variance for each velocity. No detector with these bounds can tell
the two apart. The fit ends ``--seconds`` after the fault.
"""

import argparse
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from fault_records import read, stepped

from ffsm_drake.plugins.faults.box_squares import least_squares
from ffsm_drake.plugins.faults.detection import Detector
from ffsm_drake.plugins.faults.known import SPAN
from ffsm_drake.plugins.faults.memory import Memory
from ffsm_drake.plugins.faults.panels import PanelBound
from ffsm_drake.plugins.faults.payload_error import NUM_ERRORS
from ffsm_drake.plugins.faults.windows import EVERY

SMOOTH = 4  # blocks on each side of an acceleration
EARLIER, LATER = 0.4, 0.6  # shares of the block before and of its own in a change of block means
OFFSET = 6.0  # deviations of the first velocity


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("records", type=Path, nargs="+")
    parser.add_argument("--seconds", type=float, default=4.0)
    asked = parser.parse_args(arguments)
    warnings.simplefilter("ignore")
    for path in asked.records:
        kept = read(path)
        since = 1.0 if kept["fault"] is None else float(kept["fault"]["time"][0])
        share = left_over(kept, since - 0.5, since + asked.seconds)
        fault = "no fault" if kept["fault"] is None else "{unit} {kind}".format(**kept["fault"])
        print(
            f"{kept['mission']}: {fault}: {share:.2f} noise variances for each velocity: "
            f"{'a healthy twin' if share <= 1.0 else 'no healthy twin'}",
            flush=True,
        )


def left_over(kept: dict[str, Any], first: float, last: float) -> float:
    """Mean square, in variances of noise, that a healthy spacecraft leaves between two times, s."""
    blocks = fed_blocks(kept, first, last)
    step = EVERY * kept["scenario"].sample_time
    velocity, nv = blocks["velocity"], blocks["velocity"].shape[1]
    later = np.minimum(np.arange(len(velocity)) + SMOOTH, len(velocity) - 1)
    before = np.maximum(np.arange(len(velocity)) - SMOOTH, 0)
    columns = blocks["inverse"] * blocks["bound"][:, None]
    unknowns = [_summed(columns, step)]
    low, high = -np.ones(columns.size // nv), np.ones(columns.size // nv)
    if blocks["box"].any():
        errors = blocks["errors"][later] - blocks["errors"][before]
        errors = errors.reshape(*columns.shape[:2], NUM_ERRORS)
        errors /= step * (later - before)[:, None, None]
        of_all = _summed(errors, step).reshape(errors.size // NUM_ERRORS, -1, NUM_ERRORS)
        unknowns.append(of_all.sum(axis=1))  # the same payload in all blocks
        low, high = np.append(low, blocks["box"][0]), np.append(high, blocks["box"][1])
    noise = np.tile(blocks["noise"] / np.sqrt(EVERY), len(velocity))
    offset = np.tile(np.diag(blocks["noise"]), (len(velocity), 1)) * OFFSET
    matrix = np.hstack([*unknowns, offset]) / noise[:, None]
    values = (blocks["left"] - blocks["left"][0]).ravel() / noise
    low, high = np.append(low, -np.ones(nv)), np.append(high, np.ones(nv))
    squares, _ = least_squares(matrix[None], values[None], low[None], high[None], values.size)
    return float(squares[0] / values.size)


def fed_blocks(kept: dict[str, Any], first: float, last: float) -> dict[str, np.ndarray]:
    """What detection keeps of the blocks (m, ...) that end between two times, s."""
    rows, states, panels = list[np.ndarray](), list[np.ndarray](), list[np.ndarray]()
    detector, clock = None, 0.0
    for detector, arrays, now in stepped(kept):
        memory = detector.remembered(arrays)
        new, clock = int(memory.clock - clock), memory.clock
        if new and first < now < last:
            ends = memory.rows[EVERY : new * EVERY + 1 : EVERY]
            rows.extend(memory.kept[-new:])
            states.extend(ends[:, detector._in["state"]])
            panels.extend([_of_panels(detector, memory)] * new)
    assert detector is not None
    at = detector._at
    _, inverse, bound, _ = detector._models.at(np.array(states))
    bound[:, :6] += panels
    return {
        "left": np.array(rows)[:, at["left"]],
        "velocity": np.array(rows)[:, at["velocity"]],
        "inverse": inverse,
        "bound": bound + 1e-6,
        "errors": np.array(rows)[:, at["errors"]],
        "box": np.array(detector._box),
        "noise": np.maximum(detector._velocity_noise, 1e-9),
    }


def _of_panels(detector: Detector, memory: Memory) -> np.ndarray:
    """The largest force (6) of flexible parts that detection allows."""
    if not detector._is_flexible:
        return np.zeros(6)
    return PanelBound(memory.grown, memory.grows).of(SPAN - 1, is_slope=True)


def _summed(columns: np.ndarray, step: float) -> np.ndarray:
    """Velocities (m nv, m k) by accelerations (m, nv, k) of m unknown vectors (k), one a block."""
    count, nv, size = columns.shape
    found = np.zeros((count, nv, count, size))
    for block in range(count):
        own = step * columns[block]
        found[block, :, block] += LATER * own * (block > 0)
        found[block + 1 :, :, block] += own * (1.0 if block else EARLIER)
    return found.reshape(count * nv, count * size)


if __name__ == "__main__":
    main()
