"""Hostile inputs tried in batches forked from a process with one thread (``alone``), so that an
abort or a hang of one is seen and attributed.

An input ends cleanly with a result or with an ``FfsmError`` of one line.
"""

import faulthandler
import resource
import warnings
from functools import partial
from pathlib import Path

from children import forked
from hypothesis import HealthCheck, Phase, given, seed, settings

from ffsm_drake.common.errors import FfsmError

LONGEST = 60  # s for one input, on a busy machine
MOST_MEMORY = 3 * 2**30  # bytes beyond what is taken at the start
_BATCH = 50


def drawn(strategy, count, *, start=0):
    """So many inputs; the same seed draws the same."""
    inputs = []
    limits = settings(
        max_examples=count, deadline=None, database=None, phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )  # fmt: skip

    def take(drawn_input):
        inputs.append(drawn_input)

    seed(start)(limits(given(strategy)(take)))()
    return inputs


def unclean(inputs, check):
    """{index: what happened} of the inputs that do not end cleanly in ``check(input)``."""
    found, first = {}, 0
    while first < len(inputs):
        last = min(first + _BATCH, len(inputs))
        fork = forked(partial(_try_each, inputs, range(first, last), check), silence=LONGEST)
        told = [line.partition(" ") for line in fork.told.split("\n") if line]
        found |= {int(index): text for index, _, text in told if text}
        reached = max((int(index) for index, _, _ in told), default=first)
        if fork.death or fork.code:
            found[reached] = fork.death or f"ended with {fork.code}"
        first = reached + 1
    return found


def _try_each(inputs, indices, check, tell):
    """Tell each index as it begins, and what is unclean."""
    taken = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (taken + MOST_MEMORY, resource.RLIM_INFINITY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    warnings.simplefilter("ignore")
    faulthandler.disable()
    for index in indices:
        tell(f"{index} \n")
        problem = _problem(check, inputs[index])
        if problem:
            tell(f"{index} {problem}\n")


def _problem(check, given):
    try:
        check(given)
    except FfsmError as error:
        text = str(error)
        return "" if text and len(text.splitlines()) == 1 else f"not one line: {text!r}"
    except BaseException as error:
        return " ".join(f"{type(error).__name__}: {error}".split())[:300]
    return ""
