"""Adaptive zero reaction control: its equations with Drake's plants, and what adaptation gains."""

import dataclasses

import numpy as np
import pytest

from ffsm_drake import load_scenario, make_nominal_plant, make_rollout, simulate_many
from ffsm_drake.mission import Mission, make_mission
from ffsm_drake.plugins.task_space.resolved_rate import ResolvedRate
from ffsm_drake.scenario import MassProperties
from ffsm_drake.spacecraft.coordinates import halves
from ffsm_drake.systems.controllers import make_law

LAW = "adaptive_zero_reaction"
RATES = {"mass_rate": 1e6, "moment_rate": 1e6, "inertia_rate": 1e6}
NO_ADAPTATION = dict.fromkeys(RATES, 0.0)


def properties_of(theta):
    """Mass properties of parameters [m; m c; I about the frame's origin]."""
    mass, (x, y, z) = theta[0], theta[1:4] / theta[0]
    arms = [y * y + z * z, x * x + z * z, x * x + y * y, -x * y, -x * z, -y * z]
    return MassProperties(
        mass=float(mass), center_of_mass=[float(x), float(y), float(z)],
        inertia=(theta[4:] - mass * np.array(arms)).tolist(),
    )  # fmt: skip


class Plants:
    """H and C v of the nominal plant, and their changes for one unit of each parameter."""

    def __init__(self, scenario):
        given = scenario.payload.nominal
        inertia = [*given.inertia, 0.0, 0.0, 0.0][:6]
        theta = np.array([given.mass, 0.0, 0.0, 0.0, *inertia])
        assert not any(given.center_of_mass)
        self.models = [
            make_nominal_plant(
                dataclasses.replace(
                    scenario,
                    payload=dataclasses.replace(scenario.payload, nominal=properties_of(each)),
                    actuation=dataclasses.replace(scenario.actuation, driven=["all"]),
                )
            )
            for each in (theta, *(theta + np.eye(10)))
        ]

    def at(self, q, v):
        """H (nv, nv), its changes (10, nv, nv), C v (nv) and its changes (10, nv)."""
        H = np.array([model.calc_mass_matrix(q) for model in self.models])
        b = np.array([model.calc_bias(q, v) for model in self.models])
        return H[0], H[1:] - H[0], b[0], b[1:] - b[0]


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
def test_forces_are_those_of_the_equations(seed):
    """At each sample of a run, from Drake's plants; theta_hat is integrated alongside."""
    random = np.random.default_rng(seed)
    gains = {
        "k_base": random.uniform(0.5, 2.0), "k_p_position": random.uniform(0.5, 3.0),
        "k_v": random.uniform(10.0, 30.0), "k_p_plan": random.uniform(0.5, 3.0),
        "prediction": random.uniform(1e-4, 2e-3),
        **{name: rate * random.uniform(0.5, 2.0) for name, rate in RATES.items()},
    }  # fmt: skip
    scenario = load_scenario("reaction_null", [
        f"controller={LAW}", "duration=1.5", "reference.duration=15",
        "payload.nominal={mass: 70, inertia: [12, 13, 11]}",
        "sensing.velocity_noise=1e-5", "sensing.position_noise=1e-4",
        *(f"controllers.{LAW}.{name}={value}" for name, value in gains.items()),
    ])  # fmt: skip
    log, plants = make_rollout(Mission(scenario)).run(), Plants(scenario)
    model, theta, moved = plants.models[0], np.zeros(10), 0.0
    sizes = np.repeat([gains[name] for name in RATES], [1, 3, 6])
    hand = model.plant.GetFrameByName(
        "end_effector", model.plant.GetModelInstanceByName("servicer")
    )
    for k in range(len(log.time)):
        measured, desired = log["measurement"][k], log["desired_state"][k]
        (q, v), (_, v_d) = halves(measured), halves(desired)
        H, changes, bias, biases = plants.at(q, v)
        H, bias = H + np.tensordot(theta, changes, 1), bias + theta @ biases
        e = model.calc_tracking_errors(desired, measured, q.size)[0]
        path, J = log["desired_frame"][k], model.calc_jacobian(q, hand)[3:]
        e_x = path[4:7] - model.calc_frame_pose(q, hand)[4:]
        base, arm = slice(0, 6), slice(6, None)
        F = -np.linalg.inv(H[base, base]) @ H[base, arm]
        b = v_d[:3] + _short(gains["k_base"] * e[:3])
        x = path[10:13] + _short(gains["k_p_position"] * e_x)
        reaction = np.linalg.pinv(F[:3])
        rates = v_d[arm] + gains["k_p_plan"] * e[arm]
        rates = rates + reaction @ (b - F[:3] @ rates)
        star, free = J[:, arm] + J[:, base] @ F, np.eye(7) - reaction @ F[:3]
        assert np.linalg.svd(star @ free)[1][2] > 0.1
        assert np.linalg.svd(F[:3])[1][2] > 0.01
        rates = rates + np.linalg.pinv(star @ free) @ (x - star @ rates)
        reduced = H[arm, arm] + H[arm, base] @ F
        force = reduced @ (gains["k_v"] * (rates - v[arm])) + bias[arm] + F.T @ bias[base]
        found = log["generalized_force"][k][arm]
        np.testing.assert_allclose(found, force, atol=1e-8 * np.abs(force).max())
        W = np.array([(each @ v)[base] for each in changes]).T
        lever = np.linalg.inv(H[base, base]) @ W
        rate = lever[:3].T @ e[:3] + (J[:, base] @ lever).T @ e_x
        rate -= gains["prediction"] * W.T @ (H[base] @ v)
        theta = theta + scenario.sample_time * sizes * rate
        moved = max(moved, np.abs(theta).max())
    assert moved > 0.1


def _short(vector):
    """At most 0.1, the default of ``speed_limit``."""
    return vector * min(1.0, 0.1 / max(np.linalg.norm(vector), 1e-12))


def missions(seeds, gains):
    """Drawn payloads that the law does not know, on a shorter path of ``reaction_null``."""
    for seed in seeds:
        random = np.random.default_rng(seed)
        mass = random.uniform(60.0, 100.0)
        inertia = (random.uniform(0.6, 1.2, 3) * 16.7 * mass / 100.0).tolist()
        yield load_scenario("reaction_null", [
            f"controller={LAW}", f"random_seed={seed}",
            f"payload.nominal={{mass: {mass}, inertia: {inertia}}}",
            f"controllers.{LAW}={gains}", "duration=15",
        ])  # fmt: skip


@pytest.mark.long
def test_adaptation_reduces_the_reaction_of_drawn_payloads():
    """The largest and the last rotation of the base, with adaptation and without."""
    seeds, turns = range(8), []
    for gains in ({}, NO_ADAPTATION):
        runs = simulate_many(list(missions(seeds, gains)), engine="compiled")
        assert all(run.outcome.status == "completed" for run in runs)
        turns.append([run.metrics["drift"]["largest"]["base_rotation"] for run in runs])
    with_it, without = map(np.array, turns)
    assert (with_it < without).all()
    assert np.median(with_it / without) < 0.6


@pytest.mark.smoke
def test_a_driven_base_has_resolved_rate_control():
    scenario = load_scenario("seven_joint", [f"controller={LAW}"])
    law = make_law(make_mission(scenario), make_nominal_plant(scenario))
    assert isinstance(law, ResolvedRate)
    assert law.k_v == 20.0
