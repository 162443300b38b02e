"""A control law in a loop written here: the true plant in Drake's simulator, no sensors."""

import dataclasses

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator

from ffsm_drake import make_nominal_plant, make_true_plant
from ffsm_drake.mission import make_mission
from ffsm_drake.spacecraft.coordinates import tracking_errors
from ffsm_drake.systems.controllers import Sample, make_law

# of postcapture: the nominal payload as the true one, and a posture
EXACT = "payload.nominal={mass: 100, inertia: [16.7, 16.7, 16.7]}"
FIRST = np.concatenate([[1.0], np.zeros(6), [0.2, 0.4, 1.0, 0.6, -0.7]])


@dataclasses.dataclass(frozen=True, kw_only=True)
class Course:
    """Rows at each control sample, before it."""

    time: np.ndarray  # (n,) s
    state: np.ndarray  # (n, nq + nv) [q; v]
    error: np.ndarray  # (n, nv)
    force: np.ndarray  # (n, nv) commanded
    memory: dict[str, np.ndarray]  # (n, ...)
    law: object


def flown(scenario, reference, duration, *, start=None, disturbance=None):
    """The course of a scenario's law along ``reference``: t -> q_d (nq), v_d (nv), a_d (nv).

    Args:
      start: [q; v] (nq + nv); default: the reference's.
      disturbance: t -> generalized force (nv) on the plant.
    """
    law, true = (
        make_law(make_mission(scenario), make_nominal_plant(scenario)),
        make_true_plant(scenario),
    )
    plant: MultibodyPlant = true.plant
    simulator = Simulator(plant, true.context.Clone())
    config = scenario.simulator_config
    ApplySimulatorConfig(config, simulator)
    context = simulator.get_mutable_context()
    port = plant.get_applied_generalized_force_input_port()
    period, nq = scenario.sample_time, plant.num_positions()
    q_d, v_d, _ = reference(0.0)
    plant.SetPositionsAndVelocities(context, np.concatenate([q_d, v_d]) if start is None else start)
    state, rows = dict(law.initial_state()), []
    force = np.zeros(plant.num_velocities())
    undriven = ~true.coordinates.is_driven
    for k in range(round(duration / period)):
        actual = plant.GetPositionsAndVelocities(context).copy()
        q_d, v_d, a_d = reference(k * period)
        e, e_dot = tracking_errors(np.concatenate([q_d, v_d]), actual, nq)
        e[undriven] = e_dot[undriven] = 0.0
        sample = Sample(actual[:nq], actual[nq:], q_d, v_d, a_d, e, e_dot, force, k == 0)
        force, after = law.step(sample, state)
        rows.append((k * period, actual, e, force, {key: state[key] for key in state}))
        state = dict(after)
        extra = 0.0 if disturbance is None else disturbance(k * period)
        port.FixValue(context, force + extra)
        simulator.AdvanceTo((k + 1) * period)
    time, states, errors, forces, memories = zip(*rows, strict=True)
    return Course(
        time=np.array(time), state=np.array(states), error=np.array(errors),
        force=np.array(forces), law=law,
        memory={key: np.array([each[key] for each in memories]) for key in memories[0]},
    )  # fmt: skip


def swinging(first, amplitudes, frequencies, *, base_axis=2):
    """A reference: coordinates from ``first`` (nq) by a (1 - cos w t), the base about one axis.

    Args:
      amplitudes, frequencies: (nv); of the base's rotation only the entry of ``base_axis`` counts.
    """

    def reference(t):
        way = amplitudes * (1.0 - np.cos(frequencies * t))
        v = amplitudes * frequencies * np.sin(frequencies * t)
        a = amplitudes * frequencies**2 * np.cos(frequencies * t)
        for values in (way, v, a):
            values[:3] = np.where(np.arange(3) == base_axis, values[:3], 0.0)
        half = 0.5 * way[base_axis]
        q = first.copy()
        q[:4] = [np.cos(half), 0.0, 0.0, 0.0]
        q[1 + base_axis] = np.sin(half)
        q[4:] += way[3:]
        return q, v, a

    return reference


def resting(time):
    """The reference that stays at ``FIRST``."""
    return FIRST, np.zeros(11), np.zeros(11)


# coordinates of postcapture from ``FIRST``, each at its own pace
SWING = swinging(
    FIRST,
    np.array([0.0, 0.0, 0.2, 0.1, 0.1, -0.1, 0.2, 0.2, -0.2, 0.3, 0.2]),
    np.linspace(0.5, 1.5, 11),
)
