"""NumPy code to trace, and the numbers that a tape gives."""

import math

import numpy as np

from ffsm_drake.common.choice import repeated
from ffsm_drake.plugins.tape.numbers import Traceable

KINDS = {
    "add": lambda x, y: x + y, "subtract": lambda x, y: x - y, "multiply": lambda x, y: x * y,
    "divide": lambda x, y: float(np.float64(x) / y), "negate": lambda x: -x,
    "abs": abs, "sqrt": math.sqrt,
    "sine": math.sin, "cosine": math.cos, "copysign": math.copysign, "floor": math.floor,
    "rint": lambda x: float(np.rint(x)), "max": max, "min": min,
    "pow": lambda x, y: float(np.float64(x) ** y),
    "lt": lambda x, y: x < y, "le": lambda x, y: x <= y, "eq": lambda x, y: x == y,
    "ne": lambda x, y: x != y, "and": lambda x, y: x and y, "or": lambda x, y: x or y,
    "not": lambda x: not x, "select": lambda c, x, y: x if c else y,
}  # fmt: skip


def evaluated(tape, values, result):
    """What a traced result is for values (n) of the only input, or of inputs by name."""
    made = []
    for kind, operands in tape.operations:
        if kind == "input":
            own = values[operands[0]] if isinstance(values, dict) else values
            made.append(own[operands[1]])
            continue
        given = [made[each] if type(each) is int else each for each in operands]
        if kind == "loop":
            made.append(looped(tape.loops[given[0]], given[1:]))
            continue
        if kind == "entry":
            made.append(given[0][int(given[1])])
            continue
        made.append((KINDS.get(kind) or getattr(math, kind))(*given))
    flat = np.asarray(result, dtype=object).ravel()
    entries = [made[each.index] if isinstance(each, Traceable) else each for each in flat]
    return np.array(entries, dtype=float).reshape(np.shape(result))


def looped(loop, given):
    """The state after a loop."""
    size = len(loop.after)
    state, fixed = given[:size], given[size:]
    for _ in range(loop.most):
        if state[0]:
            state = evaluated(loop.tape, {"state": state, "fixed": fixed}, loop.after).tolist()
    return state


M = np.random.default_rng(3).normal(size=(4, 4))
SPD = M @ M.T + np.eye(4)
CASES = {
    "sums": lambda x: [x + 1.0, 1.0 - x, -x, x - x, 0.0 * x, x.sum(), np.sum(x), np.mean(x)],
    "products": lambda x: [x * x, 2.0 * x, M @ x, x @ M, M.dot(x), x @ x, np.outer(x, x), x.prod()],
    "quotients": lambda x: [1.0 / (2.0 + x * x), x / 3.0, x / (1.0 + x * x), np.reciprocal(2 + x)],
    "powers": lambda x: [x**2, np.abs(x) ** 0.5, np.abs(x) ** 1.3, np.square(x), 2.0 ** x],
    "scalars": lambda x: [np.float64(2.0) * x[0], x[1] + np.float64(1.0), np.sqrt(abs(x[2]))],
    "functions": lambda x: [f(x) for f in (np.sin, np.cos, np.tanh, np.exp, np.arctan, np.floor,
                                           np.ceil, np.rint, np.trunc, np.sign, np.abs, np.log1p)],
    "two": lambda x: [np.arctan2(x, M[0]), np.hypot(x, M[0]), np.copysign(x, M[0]), np.fmod(7, 3)],
    "largest": lambda x: [np.maximum(x, 0.1), np.minimum(x, M[0]), x.max(), np.min(x), x.clip(0, 1),
                          np.clip(x, -0.2, 0.2), np.maximum.reduce(np.abs(x), keepdims=True)],
    "chosen": lambda x: [np.where(x > 0.1, x, M[0]), np.where((x > 0) & (x < 1), 1.0, 2.0),
                         np.where(~(x >= 0) | (x == x[0]), x, -x), np.sign(x - 0.1) * x,
                         np.where(np.any(x > 0.5), x, 0.0), (x > 0) * 2.0, np.logical_not(x > 0),
                         *(truth * 1.0 for of in ([True, False, True, False], x < M[0])
                           for truth in ((x > 0.1) == of, (x > 0.1) != of, of != (x > 0.1)))],
    "masked": lambda x: masked(x),
    "shapes": lambda x: [x.reshape(2, 2).T, np.concatenate([x, M[0]]), np.stack([x, x]), x[::-1],
                         np.hstack([x, 1.0]), np.tile(x, 2), *np.split(x, 2), x[[2, 0]],
                         np.swapaxes(x[None], 0, 1), np.zeros_like(x), np.full_like(x, 2.0)],
    "vectors": lambda x: [np.cross(x[:3], M[0, :3]), np.linalg.norm(x), np.dot(x, x),
                          np.linalg.norm(x.reshape(2, 2), axis=1), np.cumsum(x)],
    "solved": lambda x: [np.linalg.solve(SPD + np.outer(x, x), x),
                         np.linalg.inv(SPD + np.diag(x**2)),
                         np.linalg.solve(SPD[None] + np.outer(x, x), x[None, :, None])],
    "rounded": lambda x: [np.round(x, 1), np.sinc(x), np.remainder(x, 0.3), np.isfinite(x) * 1.0],
}  # fmt: skip


def masked(x):
    y = x.copy()
    y[y > 0.2] = 0.0
    z = np.zeros_like(x)
    z[1:3] = x[:2]
    z[0] += x[3]
    return [y, z]


def halved(x, most):
    """Numbers (2), halved until the first is below 1, and the second as often."""

    def step(state, fixed):
        y = state["x"] * fixed["share"]
        return {"goes": y[0] > 1.0, "x": y}

    return repeated(step, {"goes": x[0] > 1.0, "x": x}, {"share": np.array(0.5)}, most=most)["x"]
