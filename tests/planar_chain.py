"""A free base with an arm in a plane, from point masses and unit vectors: NumPy only."""

import dataclasses

import numpy as np


def along(angle):
    return np.array([np.cos(angle), np.sin(angle)])


@dataclasses.dataclass(frozen=True, kw_only=True)
class PlanarChain:
    """q = x, y and angle of the base (at its centre of mass), then joint angles."""

    masses: tuple[float, ...]  # kg: base, links
    inertias: tuple[float, ...]  # kg m^2, about centres of mass
    mount: tuple[float, float]  # m, of the first joint in the axes of the base
    lengths: tuple[float, ...]  # m, of the links
    centers: tuple[float, ...]  # m, from a link's joint to its centre of mass

    def motion(self, q, v):
        """Jacobians (bodies, 3, nv) of the x, y and angle of the bodies, and J' v (bodies, 2)."""
        jacobian = np.zeros((len(self.masses), 3, len(q)))
        jacobian[:, [0, 1, 2], [0, 1, 2]] = 1.0
        bias = np.zeros((len(self.masses), 2))
        turn = np.array([along(q[2]), along(q[2] + np.pi / 2.0)]).T
        arms = [(turn @ self.mount, 3)]  # each with the number of coordinates that turn it
        for k, (length, center) in enumerate(zip(self.lengths, self.centers, strict=True)):
            jacobian[k + 1, 2, 3 : 4 + k] = 1.0
            direction = along(q[2 : 4 + k].sum())
            for arm, end in (*arms, (center * direction, 4 + k)):
                jacobian[k + 1, :2, 2:end] += np.array([[-arm[1]], [arm[0]]])
                bias[k + 1] -= arm * v[2:end].sum() ** 2
            arms.append((length * direction, 4 + k))
        return jacobian, bias

    def dynamics(self, q, v):
        """Mass matrix (nv, nv) and bias force (nv)."""
        jacobian, bias = self.motion(q, v)
        weights = np.array([self.masses, self.masses, self.inertias]).T
        return (
            np.einsum("bik,bi,bil->kl", jacobian, weights, jacobian),
            np.einsum("bik,b,bi->k", jacobian[:, :2], self.masses, bias),
        )

    def acceleration(self, q, v, force):
        mass, bias = self.dynamics(q, v)
        return np.linalg.solve(mass, force - bias)
