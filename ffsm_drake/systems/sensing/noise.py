"""Sources of the sensors' noise: of a seed, the samples that Drake's sources give."""

from collections.abc import Sequence

import numpy as np
from pydrake.common import RandomDistribution, RandomGenerator
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, LeafSystem, State, System
from pydrake.systems.primitives import Gain, LinearSystem, RandomSource

from ffsm_drake.common.lifetime import untie, weak_callback
from ffsm_drake.systems.sensing.errors import SensorErrors
from ffsm_drake.systems.side_by_side import SideBySide

_DRAWN = 256  # samples of noise at once, for several copies of the spacecraft


class Noise(Diagram):
    """Gaussian noise, output ``noise``: a shaping system gets independent samples of deviation 1,
    one for each control period and input.
    """

    def __init__(self, name: str, shaped_by: System, *, copies: int, sample_time: float) -> None:
        super().__init__()
        builder, self._shaped_by = DiagramBuilder(), shaped_by
        builder.AddNamedSystem("shaped", shaped_by)
        size = shaped_by.get_input_port().size()
        self._samples = (
            RandomSource(RandomDistribution.kGaussian, size, sample_time)
            if copies == 1
            else _Samples(size // copies, copies=copies, sample_time=sample_time)
        )
        builder.AddNamedSystem("samples", self._samples)
        builder.Connect(self._samples.get_output_port(), shaped_by.get_input_port())
        builder.ExportOutput(shaped_by.get_output_port(), "noise")
        builder.BuildInto(self)
        self.set_name(name)

    def set_random(self, context: Context, generators: Sequence[RandomGenerator]) -> None:
        """See ``Sensing.set_random``."""
        if isinstance(self._shaped_by, SideBySide):
            own = self.GetMutableSubsystemContext(self._shaped_by, context)
            self._shaped_by.set_random(own, generators)
        if isinstance(self._samples, _Samples):
            self._samples.set_random(generators)


class _Samples(LeafSystem):
    """Gaussian samples of deviation 1 of several copies of the spacecraft, as a RandomSource gives
    each with its seed: drawn in advance, as an event for each source and sample takes longer.

    Output and discrete state: (copies * size), updated every ``sample_time``.
    """

    def __init__(self, size: int, *, copies: int, sample_time: float) -> None:
        super().__init__()
        builder = DiagramBuilder()
        # each of its updates draws _DRAWN samples
        self._sources = [
            builder.AddSystem(RandomSource(RandomDistribution.kGaussian, _DRAWN * size, 1.0))
            for _ in range(copies)
        ]
        self._simulator = Simulator(builder.Build())
        self._sample_time = sample_time
        self._rows, self._block = np.zeros((_DRAWN, copies * size)), 0
        self._value = self.DeclareDiscreteState(copies * size)
        self.DeclareStateOutputPort("samples", self._value)
        # Same order as in RandomSource: before the discrete updates of the same instant, its
        # readers.
        self.DeclarePeriodicUnrestrictedUpdateEvent(sample_time, 0.0, weak_callback(self._update))
        untie(self)

    def set_random(self, generators: Sequence[RandomGenerator]) -> None:
        """Begin a run: the copies draw their seeds."""
        diagram = self._simulator.get_system()
        context = diagram.CreateDefaultContext()
        for source, generator in zip(self._sources, generators, strict=True):
            source.SetRandomContext(source.GetMyMutableContextFromRoot(context), generator)
        self._simulator.reset_context(context)
        self._block = 0
        self._read()

    def _read(self) -> None:
        context = self._simulator.get_context()
        drawn = [
            source.get_output_port().Eval(source.GetMyContextFromRoot(context)).reshape(_DRAWN, -1)
            for source in self._sources
        ]
        self._rows = np.concatenate(drawn, axis=1)

    def _update(self, context: Context, state: State) -> None:
        # A RandomSource draws once before its first update.
        block, row = divmod(round(context.get_time() / self._sample_time) + 1, _DRAWN)
        while self._block < block:
            self._simulator.AdvanceTo(self._block)
            self._simulator.AdvancePendingEvents()
            self._block += 1
            self._read()
        state.get_mutable_discrete_state().set_value(self._value, self._rows[row])


def white_noise(errors: Sequence[SensorErrors]) -> Noise:
    """Return one independent Gaussian sample per entry of [q; v] and control period, held in
    between.
    """
    deviations = np.concatenate([each.deviation for each in errors])
    step = errors[0].sample_time
    return Noise("white_noise", Gain(deviations), copies=len(errors), sample_time=step)


def drift(errors: Sequence[SensorErrors]) -> Noise:
    """Return random walks of the velocities' bias, from zero, and correlated noise."""
    drifts, step = [_drift(each) for each in errors], errors[0].sample_time
    port = drifts[0].get_input_port().get_name()
    shaped = drifts[0] if len(drifts) == 1 else SideBySide(drifts, [port])
    return Noise("drift", shaped, copies=len(errors), sample_time=step)


def _drift(errors: SensorErrors) -> LinearSystem:
    """First-order Gauss-Markov processes, stationary from the start, from independent samples."""
    drift = errors.drift()
    shown = np.eye(drift.kept.size)
    system = LinearSystem(
        A=np.diag(drift.kept),
        B=np.diag(drift.added),
        C=shown,
        D=np.zeros_like(shown),
        time_period=errors.sample_time,
    )
    system.configure_random_state(np.diag(drift.start**2))
    return system
