"""The user-supplied block responsible for a failed run."""

import contextlib
import dataclasses
import re
from collections.abc import Iterator, Mapping

import numpy as np
from pydrake.systems.framework import Context, Diagram, System

from ffsm_drake.common.errors import BlockError, one_line
from ffsm_drake.common.guard import failure, user_frame
from ffsm_drake.loop.closed_loop import ClosedLoop
from ffsm_drake.scenario import kind_of

# For each kind of block: signal -> output port, and whether it is a state [q; v].
_OUTPUTS = {
    "reference": {
        "desired_state": ("desired_state", True),
        "desired_acceleration": ("desired_acceleration", False),
    },
    "sensing": {"measurement": ("estimated_state", True)},
    "actuation": {"applied_force": ("applied_force", False)},
    "forces": {"disturbance_force": ("generalized_force", False)},  # or its own signal
}
_UNIT = 0.1  # a quaternion's norm may differ from 1 by this


@dataclasses.dataclass(frozen=True, kw_only=True)
class BadOutput:
    """The first unusable output of a user-supplied block at a control sample."""

    sample: int
    problem: str


def failure_of(
    error: BaseException,
    loop: ClosedLoop,
    suspects: Mapping[str, str],
    root_context: Context,
) -> BlockError:
    """Return the error that names the source block of an exception.

    Args:
      error: the exception.
      loop: the closed loop of the run.
      suspects: its user-supplied blocks: name -> words.
      root_context: context of the diagram at the failure.
    """
    time = root_context.get_time()
    if user_frame(error) is None and (problem := _bad_now(loop, suspects, root_context)):
        return BlockError(f"{problem}; at t = {time:.2f} s")
    systems = {id(system): name for name in suspects for system in _systems(loop.blocks.get(name))}
    found, place = None, error.__traceback__
    while place is not None:
        first = place.tb_frame.f_code.co_varnames[:1]
        owner = place.tb_frame.f_locals.get(first[0]) if first else None
        found = systems.get(id(owner), found)
        place = place.tb_next
    return failure(error, suspects[found] if found else " or ".join(suspects.values()), time)


def unconnected(error: BaseException, loop: ClosedLoop) -> str:
    """Return the problem of a block that reads an input port to which nothing is connected; empty:
    another failure.
    """
    text = one_line(error)
    found = re.search(r"required InputPort\[\d+\] \((\S+)\) of System (\S+) .* is not conn", text)
    if found is None:
        return ""
    port, path = found[1], found[2].split("::")
    block = next((name for name, each in loop.blocks.items() if each.get_name() in path), path[-1])
    problem = f"nothing is connected to its input port '{port}'"
    return f"blocks.{block}: {problem}: no block of this scenario has such an output"


def _bad_now(loop: ClosedLoop, suspects: Mapping[str, str], root_context: Context) -> str:
    """Return the problem of the first user-supplied block whose output cannot be used; empty:
    none.
    """
    for name, block in suspects.items():
        for port, is_state in _OUTPUTS.get(kind_of(name), {}).values():
            system = loop.blocks[name]
            with contextlib.suppress(Exception):  # the failure itself, perhaps
                context = system.GetMyContextFromRoot(root_context)
                value = np.array(system.GetOutputPort(port).Eval(context))[None]
                if not _right(value, is_state)[0]:
                    return _problem(block, port, value[0], is_state)
    return ""


def _right(values: np.ndarray, is_state: bool) -> np.ndarray:
    """Whether each of some outputs (n, size) can be used."""
    finite = np.isfinite(values).all(axis=1)
    norm = np.linalg.norm(values[:, :4], axis=1) if is_state else np.ones(len(values))
    return finite & (np.abs(norm - 1.0) <= _UNIT)


def _problem(block: str, name: str, value: np.ndarray, is_state: bool) -> str:
    what = "is not finite"
    if np.isfinite(value).all():
        what = f"has a quaternion of norm {np.linalg.norm(value[:4]):.3g}"
    wanted = "finite, [q; v] with a unit quaternion" if is_state else "finite"
    return f"{block}: its {name} {what}; it must be {wanted}"


def _systems(block: System | None) -> Iterator[System]:
    """A block's system, and those within it."""
    if block is not None:
        yield block
    if isinstance(block, Diagram):
        for part in block.GetSystems():
            yield from _systems(part)


def bad_output(
    sound: np.ndarray, series: Mapping[str, np.ndarray], suspects: Mapping[str, str]
) -> BadOutput | None:
    """Return the first unusable output of a user-supplied block, other than the controller, while
    the state is within bounds; None: there is none.

    Args:
      sound: whether the state is within bounds, at each control sample (n,).
      series: the signals at the control samples.
      suspects: see ``failure_of``.
    """
    found = []
    for name, block in suspects.items():
        kind, own = kind_of(name), f"force_{name.partition('.')[2]}"
        for signal, (port, is_state) in _OUTPUTS.get(kind, {}).items():
            values = series.get(own, series[signal])
            right = _right(values, is_state)
            if kind == "actuation":  # the force is finite
                right |= ~np.isfinite(series["generalized_force"]).all(axis=1)
            bad = np.flatnonzero(sound & ~right)
            if bad.size:
                problem = _problem(block, port, values[bad[0]], is_state)
                found.append(BadOutput(sample=int(bad[0]), problem=problem))
    return min(found, key=lambda each: each.sample, default=None)
