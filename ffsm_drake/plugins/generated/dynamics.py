"""Dynamics ``generated``: a spacecraft's own compiled code, held to Drake before its first use."""

from collections.abc import Sequence
from typing import Any

from pydrake.multibody.plant import MultibodyPlant

from ffsm_drake.common.memo import memoized
from ffsm_drake.plugins.compiled.compiling import llvm
from ffsm_drake.plugins.equations.tree import Reader, Tree
from ffsm_drake.plugins.generated.comparison import Differences
from ffsm_drake.plugins.generated.copies import GeneratedCopies, GeneratedModel, model_of
from ffsm_drake.plugins.generated.kernels import Kernels
from ffsm_drake.plugins.generated.plant import GeneratedPlant
from ffsm_drake.scenario import Model, Scenario
from ffsm_drake.spacecraft.copies import Copies
from ffsm_drake.spacecraft.dynamics import Dynamics, NotCovered
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.spacecraft.plant import make_plant

LARGEST_DIFFERENCE = 1e-11  # from Drake, as a share of the terms of an equation
SCHEMES = ("explicit_euler", "runge_kutta2", "runge_kutta3")


class Generated(Dynamics):
    """The equations of a spacecraft as machine code for many copies at once."""

    name = "generated"
    batch = 64

    def __init__(self) -> None:
        """Raises FfsmError: llvmlite is missing."""
        llvm()

    def check(self, scenario: Scenario) -> None:
        """See Dynamics."""
        scheme = scenario.simulator_config.integration_scheme
        if scheme not in SCHEMES:
            known = ", ".join(SCHEMES)
            raise NotCovered(f"integration_scheme {scheme} (but {known})")

    def copies(self, model: Model, number: int) -> Copies:
        """See Dynamics."""
        single = make_plant(model, flexible=True)
        reader = Reader(single)
        kernels = held_to_drake(reader.tree, plant=single)
        plant: Any = GeneratedPlant(kernels, number)
        return GeneratedCopies(number=number, plant=plant, single=single, reader=reader)

    def models(self, models: Sequence[PlantModel], scenario: Scenario) -> GeneratedModel:
        """See Dynamics."""
        first = models[0].plant
        return model_of(models, held_to_drake(Reader(first).tree, plant=first))


@memoized(maxsize=16, besides="plant")  # compared once in a process
def held_to_drake(tree: Tree, *, plant: MultibodyPlant) -> Kernels:
    """The compiled code of a plant's tree. Raises NotCovered: it differs from the plant."""
    kernels = Kernels(tree)
    found = Differences(kernels, plant).largest
    if not found <= LARGEST_DIFFERENCE:
        raise NotCovered(f"code that differs from Drake by {found:.1e}")
    return kernels
