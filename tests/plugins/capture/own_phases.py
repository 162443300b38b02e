"""Phases of a user's own, for test_phases."""

import dataclasses

from pydrake.systems.primitives import ConstantVectorSource

from ffsm_drake import Phase
from ffsm_drake.plugins.capture.approach import approach_posture
from ffsm_drake.systems.blend import Blend
from ffsm_drake.systems.controllers.laws.tdc import Tdc
from ffsm_drake.systems.polynomial_motion import PolynomialMotion


def wait(setup):
    """Rest where the approach begins."""
    return Phase()


def other_law(setup):
    """Likewise, under another law."""
    return Phase(blocks={"controller": Tdc})


def come(setup):
    """From some metres away to where the approach begins."""
    goal, by = approach_posture(setup.scenario), setup.settings["by"]
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


def system(setup):
    """What is no phase."""
    return ConstantVectorSource([0.0])


def fails(setup):
    """Code that fails."""
    return setup.scenario.no_such_key
