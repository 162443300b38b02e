"""The sensors of ``examples/astrobee_imu.yaml``: their simulated log has the statistics of the
flight log, by the same identification (``gyro_fit``; the flight log itself: ``test_astrobee``).
"""

from pathlib import Path

import numpy as np
import pytest
from gyro_fit import Log, white_density
from pydrake.common import RandomGenerator
from pydrake.systems.analysis import Simulator
from scipy.spatial.transform import Rotation

from ffsm_drake import load_scenario, make_nominal_plant, override_scenario
from ffsm_drake.systems.sensing.part import Sensing

EXAMPLE = Path(__file__).parents[2] / "examples" / "astrobee_imu.yaml"
STEP = 0.01  # s
BIAS = np.array([-1.2e-4, 2.2e-3, 2.7e-4])  # rad/s


def attitudes(times, rng):
    """A drawn smooth motion of up to about 0.4 rad/s, as in the flight."""
    size, rate, phase = (rng.uniform(*of, (2, 3)) for of in ((0.2, 0.4), (0.2, 0.6), (0.0, 6.0)))
    angles = (size * np.sin(rate * times[:, None, None] + phase)).sum(axis=1)
    return Rotation.from_rotvec(angles)


def measured(sensing, times, flown):
    """The log (n, nq + nv) of sensors on a base in motion; other coordinates are at rest."""
    near = angular_velocities(times, flown)
    context = sensing.CreateDefaultContext()
    sensing.SetRandomContext(context, RandomGenerator(3))
    state = np.zeros(sensing.GetInputPort("state").size())
    simulator, found = Simulator(sensing, context), []
    for time, (x, y, z, w), rate in zip(times, flown.as_quat(), near, strict=True):
        if found:
            simulator.AdvanceTo(time)
        state[:4], state[12:15] = (w, x, y, z), rate
        sensing.GetInputPort("state").FixValue(context, state)
        if not found:
            simulator.Initialize()
        found.append(sensing.GetOutputPort("estimated_state").Eval(context))
    return np.array(found)


def angular_velocities(times, flown):
    """Angular velocities in world axes (n, 3), of central differences of attitudes."""
    turned = (flown[2:] * flown[:-2].inv()).as_rotvec() / (2.0 * STEP)
    return np.vstack([turned[:1], turned, turned[-1:]])


def simulated_log(seed, duration, *overrides):
    scenario = override_scenario(load_scenario(EXAMPLE), list(overrides))
    coordinates = make_nominal_plant(scenario).coordinates
    times = STEP * np.arange(round(duration / STEP))
    flown = attitudes(times, np.random.default_rng(seed))
    sensing = Sensing(scenario.sensing, coordinates, sample_time=STEP)
    log = measured(sensing, times, flown)
    gyro = flown.inv().apply(log[:, 12:15])
    new = slice(26, None, 20)  # a pose of each 20th sample arrives six samples later
    return Log(times, gyro, times[new], Rotation.from_quat(log[new][:, [1, 2, 3, 0]]))


@pytest.mark.long
def test_identification_finds_the_simulated_sensors():
    log = simulated_log(0, 20.0, "sensing.velocity_bias_walk=0")
    found = log.fit()
    assert np.degrees(found.axes.magnitude()) < 0.1
    assert found.bias == pytest.approx(BIAS, abs=6e-5)
    assert found.delay == pytest.approx(0.06, abs=3e-3)
    assert white_density(log.gyro, STEP) == pytest.approx(2.9e-5, rel=0.12)
    attitude, _, _ = log.noise(found, (1, 2, 5, 10))
    assert attitude == pytest.approx(2.4e-4, rel=0.25)
