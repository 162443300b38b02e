"""What the hands bear in a run: the wrench of the welded hand, and the used friction of all.

The wrench of the welded hand on the target is not in the equations of motion. It is the change of
the momentum of the target over a sample, without the wrenches of the other hands at its end. Other
forces on the target are left out.
"""

from typing import Any

import numpy as np

from ffsm_drake.common.numbers import usable
from ffsm_drake.common.so3 import cross_of, matrix_of
from ffsm_drake.plugins.two_arms.flow import WELD, WRENCHES
from ffsm_drake.plugins.two_arms.loads import cones_of, moved, weld_of
from ffsm_drake.scenario.contacts import ALL_HANDS, closing_contacts
from ffsm_drake.spacecraft.mass_properties import spatial_inertia
from ffsm_drake.spacecraft.plant import find_body, find_frame


def weld_wrench(run: Any) -> np.ndarray:
    """The moment and force (n, 6) of the welded hand on the target, in the axes of its place; NaN
    before the second sample after the grasp, and where another hand has just grasped.

    Args: the log of a run.
    """
    scenario, model, states = run.scenario, run.model, run.whole_states
    weld, held = weld_of(scenario), usable(states)
    place = find_frame(model.plant, scenario.contacts[weld].frame, key=f"contacts.{weld}.frame")
    q, v = np.split(states[held], [model.plant.num_positions()], axis=1)
    pose = np.full((len(states), 7), np.nan)
    total = np.full((len(states), 6), np.nan)
    pose[held] = model.calc_frame_pose(q, place)
    total[held] = _momentum(run, q, v)
    rate = np.full_like(total, np.nan)
    rate[1:] = np.diff(total, axis=0) / scenario.sample_time
    moment, force = rate[:, :3] - cross_of(pose[:, 4:], rate[:, 3:]), rate[:, 3:]
    turn = matrix_of(pose[:, :4]).mT
    found = np.hstack([(turn @ each[..., None])[..., 0] for each in (moment, force)])
    for name, (wrench, is_new) in _others(run).items():
        frame = scenario.contacts[name].frame
        other = find_frame(model.plant, frame, key=f"contacts.{name}.frame")
        found -= wrench @ moved(model, q[0], other, place).T
        found[is_new] = np.nan
    found[: 1 if run.grasp is None else run.grasp.sample + 1] = np.nan
    return found


def _momentum(run: Any, q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """The momentum (n, 6) of the target about the origin of the world, N m s and N s."""
    scenario, model = run.scenario, run.model
    body = find_body(model.plant, scenario.payload.body, key="payload.body").body_frame()
    properties = scenario.payload.truth if run.grasp is None else run.grasp.payload
    pose, inertia = model.calc_frame_pose(q, body), spatial_inertia(properties).CopyToFullMatrix6()
    R = matrix_of(pose[:, :4])
    twist = (model.calc_jacobian(q, body) @ v[..., None]).reshape(-1, 2, 3, 1)
    own = (R[:, None].mT @ twist).reshape(-1, 6) @ inertia
    spin, momentum = np.moveaxis((R[:, None] @ own.reshape(-1, 2, 3, 1))[..., 0], 1, 0)
    return np.hstack([spin + cross_of(pose[:, 4:], momentum), momentum])


def _others(run: Any) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """By name of the other hands, their wrenches (n, 6), zero while they are open, and the samples
    (n) at which they have just grasped.
    """
    closing, found = closing_contacts(run.scenario, ALL_HANDS), {}
    for name, wrench in zip(closing, np.split(run[WRENCHES], len(closing), axis=1), strict=True):
        wrench = np.nan_to_num(wrench)
        holds = wrench.any(axis=1)
        found[name] = wrench, holds & ~np.r_[False, holds[:-1]]
    return found


def used_friction(run: Any) -> np.ndarray:
    """The used share of the friction (n, hands with friction): 1 where a hand begins to slip; NaN
    where it is open, or has just grasped.

    Args: the log of a run.
    """
    others, found = _others(run), list[np.ndarray]()
    for name, cone in cones_of(run.scenario).items():
        if name in others:
            wrench, is_new = others[name]
            is_open = is_new | ~wrench.any(axis=1)
        else:
            wrench = run[WELD]
            is_open = np.isnan(wrench).any(axis=1)
        found.append(np.where(is_open, np.nan, cone.used(np.nan_to_num(wrench))))
    return np.stack(found, axis=1)
