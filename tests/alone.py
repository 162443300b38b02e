"""Processes with one thread, from which a test may fork: forks of a process with several may
deadlock.
"""

import contextlib

import children
import pytest

children.preload(
    "ffsm_drake.cli", "ffsm_drake.show.outputs",
    "ffsm_drake.plugins.analysis", "ffsm_drake.plugins.analysis.figure",
    "ffsm_drake.show.figures.run",
    "ffsm_drake.plugins.meshcat.recording", "hypothesis", "pytest",
)  # fmt: skip


@contextlib.contextmanager
def rough_drawing():
    """Pictures of few pixels, whose layout is not computed."""
    from matplotlib.figure import Figure

    save = Figure.savefig

    def roughly(figure, path, **options):
        figure.set_layout_engine("none")  # half the cost
        save(figure, path, **{**options, "dpi": 20, "bbox_inches": None})

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Figure, "savefig", roughly)
        yield


def run_alone(function, *arguments, inputs=0):
    """What a function of a module returns, or raises, in such a process, in this folder.

    The process is killed after 10 minutes, and 10 s more for each of many inputs.
    """
    return children.call(_drawn_roughly, function, *arguments, longest=600.0 + 10.0 * inputs)


def _drawn_roughly(function, *arguments):
    with rough_drawing():
        return function(*arguments)
