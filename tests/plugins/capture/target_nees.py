"""NEES of a target's filter where the inertia is drawn otherwise than the filter assumes.

python tests/plugins/capture/target_nees.py
"""

import dataclasses

import numpy as np
import test_target_filter as filters
from scipy.spatial.transform import Rotation

from ffsm_drake.plugins.capture.free_body import shape_of
from ffsm_drake.scenario import inertia_matrix

SHARE = 0.1
BODIES = {
    name: dataclasses.replace(filters.BODY, inertia=[*moments, 1.0, -0.5, 0.8])
    for name, moments in {"20, 14, 9": (20.0, 14.0, 9.0), "20, 18, 5": (20.0, 18.0, 5.0)}.items()
}


def relative(J, random):
    values, axes = np.linalg.eigh(J)
    root = (axes * np.sqrt(values)) @ axes.T
    change = random.normal(size=(3, 3))
    return root @ (np.eye(3) + SHARE * 0.5 * (change + change.T)) @ root


def turned(J, random):
    values, axes = np.linalg.eigh(J)
    axes = axes @ Rotation.from_rotvec(SHARE * random.normal(size=3)).as_matrix()
    return (axes * (values * (1.0 + SHARE * random.normal(size=3)))) @ axes.T


def by_number(J, random):
    change = np.tril(random.normal(size=(3, 3)))
    return J + np.trace(J) / 3.0 * SHARE * (change + np.tril(change, -1).T)


def drawn_by(draw, body, usual):
    """``drawn`` of the tests with inertias of a rigid body drawn by another rule."""

    def drawn(random, runs, rate):
        target, prior = usual(random, runs, rate)
        shapes = []
        while len(shapes) < runs:
            J = draw(inertia_matrix(body), random)
            least, middle, most = np.linalg.eigvalsh(J)
            if least > 0.0 and least + middle >= most:
                numbers = [*np.diagonal(J).tolist(), J[0, 1], J[0, 2], J[1, 2]]
                shapes.append(shape_of(dataclasses.replace(body, inertia=numbers)))
        return dataclasses.replace(target, shape=np.array(shapes)), prior

    return drawn


def main():
    usual = filters.drawn
    low, high = filters.band(60)
    print(f"band {low:.1f} to {high:.1f}")
    for name, body in BODIES.items():
        filters.BODY = body
        for draw in (None, relative, turned, by_number):
            filters.drawn = usual if draw is None else drawn_by(draw, body, usual)
            mean = filters.means(filters.DROPS, 60, [0], runs=60).mean()
            print(f"{name}: {draw.__name__ if draw else 'as assumed'} {mean:.1f}", flush=True)


if __name__ == "__main__":
    main()
