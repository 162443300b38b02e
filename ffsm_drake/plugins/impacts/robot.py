"""A free-floating robot with two planar arms beside a free square target.

The numbers are those of the air-bearing robot of the Space Robotics Laboratory at Tohoku University
(``two-dimensional/parameters`` of MATLAB_space_debri_capturing_sim; Uchida, Uno, Yoshida, iSpaRo
2024, doi:10.1109/iSpaRo60631.2024.10687710). Its wrists are passive; here they are held. Each hand
has two round tips. Units: m, kg, kg m^2, rad, N.
"""

import math

import numpy as np
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    FixedOffsetFrame,
    JacobianWrtVariable,
    PlanarJoint,
    RevoluteJoint,
    RigidBody,
    SpatialInertia,
    UnitInertia,
)

from ffsm_drake.plugins.impacts.contact import Surface, depth_in_square

SIDES = ("left", "right")
WIDTH, TIP = 0.15, 0.015  # width of the target, radius of a tip
TIP_REACH, TIP_ANGLE = (
    0.057505101269,
    0.763179598071,
)  # tips: from the wrist, from its axis
TORQUE_LIMIT = 10.0  # N m
# along y: length, mass, moment of inertia, centre of mass from the middle
_LINKS = (
    (0.25, 0.6328, 0.00255150, 0.09598),
    (0.18, 0.6470, 0.00118507, 0.07243),
    (0.13655, 0.14170, 0.00017569304, -0.005145),
)
_HAND = 0.065, 0.00011548236
_BASE = 0.32, 0.16, 8.3084, 0.13526810, 0.076078375  # width, depth, ..., centre of mass along y
_TARGET = 2.34844, 0.00932724
NUM_JOINTS, TARGET = 6, slice(9, 12)
JOINTS = slice(3, 9)


class Scene:
    """Robot and target: coordinates q = [base x, y, angle; joints of the left and the right arm;
    target x, y, angle] (12), rates v = dq/dt.
    """

    def __init__(self, surface: Surface) -> None:
        self.surface = surface
        self.plant = plant = MultibodyPlant(0.0)
        plant.mutable_gravity_field().set_gravity_vector(np.zeros(3))
        width, depth, mass, moment, ahead = _BASE
        base = self._body("base", mass, moment, ahead)
        plant.AddJoint(_planar("base", plant.world_body(), base))
        self.hands = list[RigidBody]()
        for side, sign in zip(SIDES, (-1.0, 1.0), strict=True):
            parent, place = base, [0.5 * sign * width, 0.5 * depth, 0.0]
            for k, (length, link_mass, link_moment, offset) in enumerate(_LINKS):
                link = self._body(f"{side}_{k}", link_mass, link_moment, 0.5 * length + offset)
                root = plant.AddFrame(
                    FixedOffsetFrame(f"{side}_{k}_root", parent.body_frame(), RigidTransform(place))
                )
                axis = [0.0, 0.0, 1.0]
                plant.AddJoint(RevoluteJoint(f"{side}_{k}", root, link.body_frame(), axis))
                parent, place = link, [0.0, length, 0.0]
            hand = self._body(f"{side}_hand", *_HAND, 0.0)
            plant.WeldFrames(parent.body_frame(), hand.body_frame(), RigidTransform(place))
            self.hands.append(hand)
        self.target = self._body("target", *_TARGET, 0.0)
        plant.AddJoint(_planar("target", plant.world_body(), self.target))
        plant.Finalize()
        self.context = plant.CreateDefaultContext()
        self.tips = [
            TIP_REACH * np.array([math.sin(turn), math.cos(turn), 0.0])
            for turn in (-TIP_ANGLE, TIP_ANGLE)
        ]

    def _body(self, name: str, mass: float, moment: float, ahead: float) -> RigidBody:
        """A body with its centre of mass ahead of its origin, along y."""
        unit = UnitInertia.SolidBox(*[math.sqrt(6.0 * moment / mass)] * 3)
        center = np.array([0.0, ahead, 0.0])
        inertia = SpatialInertia(mass, center, unit.ShiftFromCenterOfMass(center))
        return self.plant.AddRigidBody(name, inertia)

    def place(self, q: np.ndarray, v: np.ndarray) -> None:
        """Set the configuration that the other methods read."""
        self.plant.SetPositionsAndVelocities(self.context, np.concatenate([q, v]))

    def jacobian(self, body: RigidBody, point: np.ndarray) -> np.ndarray:
        """Jacobian (2, 12) of a body's point (3, body axes)."""
        world = self.plant.world_frame()
        found: np.ndarray = self.plant.CalcJacobianTranslationalVelocity(
            self.context, JacobianWrtVariable.kV, body.body_frame(), point, world, world
        )[:2]
        return found

    def bias(self, body: RigidBody, point: np.ndarray) -> np.ndarray:
        """The part (2) of a point's acceleration that the rates give."""
        world = self.plant.world_frame()
        found: np.ndarray = self.plant.CalcBiasTranslationalAcceleration(
            self.context, JacobianWrtVariable.kV, body.body_frame(), point, world, world
        )[:2].ravel()
        return found

    def contacts(self, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Generalized force (12) of the contacts at the configuration that was ``place``d, and the
        force on each tip (hand, tip, 2; N).
        """
        force, on_tips = np.zeros(12), np.zeros((2, 2, 2))
        c, s = math.cos(q[11]), math.sin(q[11])
        R = np.array([[c, -s], [s, c]])
        for i, hand in enumerate(self.hands):
            X_WH = hand.EvalPoseInWorld(self.context)
            for k, tip in enumerate(self.tips):
                center = (X_WH @ tip)[:2]
                depth, normal = depth_in_square(R.T @ (center - q[9:11]), width=WIDTH, radius=TIP)
                if depth <= 0.0:
                    continue
                normal = R @ normal
                point = center - (TIP - 0.5 * depth) * normal
                at = np.array([*point, 0.0])
                own = self.jacobian(hand, X_WH.inverse() @ at)
                other = np.zeros((2, 12))
                arm = point - q[9:11]
                other[:, TARGET] = [[1.0, 0.0, -arm[1]], [0.0, 1.0, arm[0]]]
                push = self.surface.force(depth=depth, normal=normal, velocity=(own - other) @ v)
                on_tips[i, k] = -push
                force += (other - own).T @ push
        return force, on_tips

    def momentum(self, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        """[p_x, p_y, angular momentum about the world's origin] (3) of robot and target."""
        self.place(q, v)
        found = self.plant.CalcSpatialMomentumInWorldAboutPoint(self.context, np.zeros(3))
        return np.array([*found.translational()[:2], found.rotational()[2]])

    def acceleration(self, q: np.ndarray, v: np.ndarray, torque: np.ndarray) -> np.ndarray:
        """dv/dt (12) under joint torques (6) and the contacts."""
        self.place(q, v)
        force = self.contacts(q, v)[0] - self.plant.CalcBiasTerm(self.context)
        force[JOINTS] += torque
        found: np.ndarray = np.linalg.solve(self.plant.CalcMassMatrix(self.context), force)
        return found

    def base_after(self, q: np.ndarray, joints: np.ndarray) -> np.ndarray:
        """Base's [x, y, angle] when the joints have gone straight to angles (6) at no momentum."""
        change = (joints - q[JOINTS]) / 40.0
        for _ in range(40):
            middle = q
            for share in (0.5, 1.0):  # the midpoint rule
                self.plant.SetPositions(self.context, middle)
                mass = self.plant.CalcMassMatrix(self.context)
                base = -np.linalg.solve(mass[:3, :3], mass[:3, JOINTS] @ change)
                middle = q + share * np.concatenate([base, change, np.zeros(3)])
            q = middle
        return q[:3]


def arm_joints(hand: int, base: np.ndarray, goal: np.ndarray) -> np.ndarray:
    """Joint angles (3) that bring a wrist to [x, y, angle] with the base at [x, y, angle], the
    elbow outwards; NaN: it is out of reach.
    """
    side, (first, second, third) = 2.0 * hand - 1.0, (link[0] for link in _LINKS)
    c, s = math.cos(base[2]), math.sin(base[2])
    x, y = np.array([[c, s], [-s, c]]) @ (goal[:2] - base[:2])
    angle = goal[2] - base[2]
    x += third * math.sin(angle) - 0.5 * side * _BASE[0]
    y -= third * math.cos(angle) + 0.5 * _BASE[1]
    cosine = (x * x + y * y - first**2 - second**2) / (2.0 * first * second)
    elbow = side * math.acos(cosine) if abs(cosine) < 0.95 else math.nan
    shoulder = math.atan2(-x, y) - math.atan2(
        second * math.sin(elbow), first + second * math.cos(elbow)
    )
    return np.array([shoulder, elbow, angle - shoulder - elbow])


def _planar(name: str, parent: RigidBody, child: RigidBody) -> PlanarJoint:
    return PlanarJoint(name, parent.body_frame(), child.body_frame(), [0.0, 0.0, 0.0])
