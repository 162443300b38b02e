"""Hostile inputs tried in batches forked from a process with one thread (``alone``), so that an
abort or a hang of one is seen and attributed.

An input ends cleanly with a result or with an ``FfsmError`` of one line.
"""

import faulthandler
import os
import resource
import signal
import warnings
from pathlib import Path

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
        reader, writer = os.pipe()
        child = os.fork()
        if child == 0:
            os.close(reader)
            _try_each(inputs, range(first, last), check, writer)
        os.close(writer)
        with os.fdopen(reader, encoding="utf-8") as lines:
            told = [line.rstrip("\n").partition(" ") for line in lines]
        _, status = os.waitpid(child, 0)
        found |= {int(index): text for index, _, text in told if text}
        reached = max((int(index) for index, _, _ in told), default=first)
        if os.WIFSIGNALED(status):
            found[reached] = f"ended by {signal.Signals(os.WTERMSIG(status)).name}"
        first = reached + 1
    return found


def _try_each(inputs, indices, check, writer):
    """Tell each index as it begins, and what is unclean; ends the process."""
    taken = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (taken + MOST_MEMORY, resource.RLIM_INFINITY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    warnings.simplefilter("ignore")
    faulthandler.disable()
    for index in indices:
        os.write(writer, f"{index} \n".encode())
        signal.alarm(LONGEST)
        problem = _problem(check, inputs[index])
        signal.alarm(0)
        if problem:
            os.write(writer, f"{index} {problem}\n".encode("utf-8", "replace"))
    os._exit(0)


def _problem(check, given):
    try:
        check(given)
    except FfsmError as error:
        text = str(error)
        return "" if text and len(text.splitlines()) == 1 else f"not one line: {text!r}"
    except BaseException as error:
        return " ".join(f"{type(error).__name__}: {error}".split())[:300]
    return ""
