"""Phases of a user's own, for test_phases."""

import dataclasses

import numpy as np
from pydrake.systems.primitives import ConstantVectorSource

from ffsm_drake import Phase
from ffsm_drake.plugins.capture.approach import approach_posture
from ffsm_drake.spacecraft.plant import configuration
from ffsm_drake.systems.blend import Blend
from ffsm_drake.systems.controllers.laws.tdc import Tdc
from ffsm_drake.systems.planned_motion import PlannedMotion
from ffsm_drake.systems.polynomial_motion import PolynomialMotion


def wait(setup):
    """Rest where the approach begins."""
    return Phase()


def other_law(setup):
    """Likewise, under another law."""
    return Phase(blocks={"controller": Tdc})


def come(setup):
    """From some metres away to where the approach begins."""
    goal, by = approach_posture(setup.mission), setup.settings["by"]
    away = [place + offset for place, offset in zip(goal.base_position, by, strict=True)]
    motion = PolynomialMotion(
        coordinates=setup.coordinates,
        start=dataclasses.replace(goal, base_position=away),
        target=goal,
        blend=Blend(setup.scenario.reference, setup.settings["lasts"]),
        base_rotation="eigenaxis",
        sample_time=setup.sample_time,
    )
    return Phase(motion=motion)


class Broken(PlannedMotion):
    """Rest where the approach begins, with a fault."""

    def __init__(self, setup, fault):
        super().__init__(coordinates=setup.coordinates, sample_time=setup.sample_time, end=1.0)
        goal = approach_posture(setup.mission)
        self._fault, self._goal = (
            fault,
            configuration(setup.nominal.coordinates, goal, key="posture"),
        )

    def rows(self, times):
        if self._fault == "raises":
            raise KeyError("joints")
        rows = np.tile([*self._goal, *np.zeros(22)], (times.size, 1))
        if self._fault == "nan":
            rows[times > 0.5, 9] = np.nan
        if self._fault == "turned":
            rows[:, :4] *= 1.01
        if self._fault == "moves":
            rows[:, 12 + 4] = 0.1
        return rows[:, :3] if self._fault == "narrow" else rows


def broken(setup):
    """A phase with such a motion."""
    return Phase(motion=Broken(setup, setup.settings["fault"]))


def placed(setup):
    """A phase that says what its place says."""
    return Phase(names=(("mine", 10),))


def referred(setup):
    """A phase with a reference of its own."""
    return Phase(blocks={"reference": wait})


def system(setup):
    """What is no phase."""
    return ConstantVectorSource([0.0])


def fails(setup):
    """Code that fails."""
    return setup.scenario.no_such_key
