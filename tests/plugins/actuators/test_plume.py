"""Plumes: where rays meet shapes, and what their momentum does."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydrake.geometry import Box, Capsule, Cylinder, Ellipsoid, Sphere
from pydrake.math import RigidTransform

from ffsm_drake import load_scenario, simulate
from ffsm_drake.plugins.actuators.plume import (
    PlumeField,
    RaySolids,
    allocated,
    rays_of,
    returned_shares,
)
from ffsm_drake.scenario import Plume, thrusters_of
from ffsm_drake.spacecraft.craft import make_true_plant
from ffsm_drake.spacecraft.plant import configuration

LAYOUT = "actuation.thrusters.layout=16x22N"
PLUME = "actuation.thrusters.plume={}"
SIZES = st.floats(0.05, 2.0)


def box(x, y, z):
    return Box(x, y, z), lambda p: (np.abs(p) / (0.5 * np.array([x, y, z]))).max(axis=1)


def ellipsoid(a, b, c):
    return Ellipsoid(a, b, c), lambda p: np.linalg.norm(p / [a, b, c], axis=1)


def sphere(r, *_):
    return Sphere(r), lambda p: np.linalg.norm(p, axis=1) / r


def cylinder(r, length, _):
    return Cylinder(r, length), lambda p: np.maximum(
        np.hypot(p[:, 0], p[:, 1]) / r, np.abs(p[:, 2]) / (0.5 * length)
    )


def capsule(r, length, _):
    def level(p):
        along = np.clip(p[:, 2], -0.5 * length, 0.5 * length)
        return np.hypot(np.hypot(p[:, 0], p[:, 1]), p[:, 2] - along) / r

    return Capsule(r, length), level


@given(
    st.sampled_from([box, ellipsoid, sphere, cylinder, capsule]),
    st.tuples(SIZES, SIZES, SIZES),
    st.integers(0, 10**6),
)
def test_a_ray_enters_where_it_first_reaches_the_surface(make, sizes, seed):
    shape, level = make(*sizes)  # at most 1 within
    draw = np.random.default_rng(seed)
    place = RigidTransform(draw.uniform(-1.0, 1.0, 3))
    solids = RaySolids([(0, shape, place), (0, Sphere(9.0), place)])
    solids.place(np.eye(3, 4)[None])
    p = draw.uniform(-3.0, 3.0, (50, 3))
    p = p[level(p) > 1.0 + 1e-9]
    u = draw.normal(size=p.shape)
    u[:10] = np.eye(3)[draw.integers(0, 3, 10)][: len(u)]  # along an axis
    u /= np.linalg.norm(u, axis=1)[:, None]
    rays = zip(p + place.translation(), u, strict=True)
    met = [solids.first_met(point, along[None], [1]) for point, along in rays]
    first, found = (np.ravel(each) for each in zip(*met, strict=True))
    hit = first == 0
    assert (first[~hit] == -1).all()
    assert np.allclose(level(p[hit] + found[hit, None] * u[hit]), 1.0, atol=1e-9)
    ways = np.linspace(0.0, 1.0, 400)[1:-1] * np.where(hit, np.minimum(found, 99.0), 12.0)[:, None]
    levels = np.array([level(p + way[:, None] * u) for way in ways.T])
    assert (levels > 1.0 - 1e-9).all()


@pytest.mark.parametrize("exponent", [1.0, 8.0, 40.0])
def test_momentum_within_a_cone_is_that_of_the_source_flow(exponent):
    axis = np.array([0.6, 0.0, -0.8])
    rays, part = rays_of(axis, Plume(exponent=exponent, rays=20_000))
    assert np.allclose(np.linalg.norm(rays, axis=1), 1.0)
    assert np.allclose(part * rays.sum(axis=0), axis, atol=2e-3)
    for angle in (0.1, 0.3, 0.8):
        cosine = rays @ axis
        within = part * cosine[cosine > np.cos(angle)].sum()
        # of the axial momentum: the integral of cos^(n + 1) sin, from the axis to the angle
        assert within == pytest.approx(1.0 - np.cos(angle) ** (exponent + 2.0), abs=2e-3)


def field_of(scenario, **plume):
    model = make_true_plant(scenario)
    units = thrusters_of(scenario.actuation.thrusters)
    settings = dataclasses.replace(scenario.actuation.thrusters.plume, **plume)
    q = configuration(model.coordinates, scenario.initial_posture, key="initial_posture")
    return PlumeField(settings, [*units.values()], model, scenario.model), list(units), q


def test_a_thruster_below_the_target_loses_half_of_its_thrust():
    """By hand, with the target as a sphere of 0.5 m: (11, 1.4, 8.7) N of 22 N."""
    scenario = load_scenario("thrusters_only", [LAYOUT, PLUME])
    field, names, q = field_of(scenario, rays=1000)
    thrust = np.where(np.array(names) == "top_1_x", 22.0, 0.0)
    force, each = field.calc(q, thrust)
    back = each[names.index("top_1_x")]
    assert back == pytest.approx([11.0, 1.4, 8.7], abs=2.5)
    assert force[3:6] == pytest.approx(back)  # all bodies together
    assert not each[thrust == 0.0].any()
    coarse = field_of(scenario)[0].calc(q, thrust)[1].sum(axis=0)
    assert coarse == pytest.approx(back, abs=0.05 * 22.0)
    assert returned_shares(scenario)["top_1_x"] > 0.5
    assert max(returned_shares(scenario)[name] for name in names if "bottom" in name) < 0.05


def test_a_body_that_is_not_there_yet_gets_nothing():
    scenario = load_scenario("thrusters_only", [LAYOUT, PLUME])
    model, units = make_true_plant(scenario), thrusters_of(scenario.actuation.thrusters)
    _, names, q = field_of(scenario)
    without = PlumeField(
        scenario.actuation.thrusters.plume,
        [*units.values()],
        model,
        scenario.model,
        without=scenario.payload.body,
    )
    thrust = np.where(np.array(names) == "top_1_x", 22.0, 0.0)
    alone = np.linalg.norm(without.calc(q, thrust)[1])
    assert alone < 0.5 * np.linalg.norm(field_of(scenario)[0].calc(q, thrust)[1])


@pytest.mark.slow
def test_plumes_push_and_momentum_balances_and_a_ban_keeps_a_thruster_shut():
    given = [LAYOUT, PLUME, "duration=1.5"]
    pushed = simulate(load_scenario("thrusters_only", given), check_stability=False)
    assert np.abs(pushed.dataset["plume_force"].values).max() > 1.0
    assert pushed.metrics["plume"]["impulse"] > 0.01
    for size in pushed.metrics["momentum_residual"].values():
        assert size < 1e-6
    assert pushed.metrics["plume"]["returned"]["top_1_x"] > 0.5
    banned = load_scenario("thrusters_only", [*given, "actuation.thrusters.plume.ban=0.3"])
    assert allocated(banned).thrusters.failures == {
        "top_1_x": "stuck_off",
        "top_4_x": "stuck_off",
    }
    data = simulate(banned, check_stability=False).dataset
    assert not data["thruster_open"].sel(thruster=["top_1_x", "top_4_x"]).values.any()
    assert data["thruster_open"].values.any()
