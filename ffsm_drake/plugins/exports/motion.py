"""Where the bodies and joints of a recorded run are."""

from collections.abc import Iterator

import numpy as np
from pydrake.geometry import Rgba, Role, Shape
from pydrake.math import RigidTransform
from pydrake.multibody.tree import BodyIndex
from pydrake.systems.framework import DiagramBuilder

from ffsm_drake.runs.dataset import free_target
from ffsm_drake.runs.record import RunRecord
from ffsm_drake.scenario import Scenario
from ffsm_drake.spacecraft.plant import add_combined_plant, base_body, find_body, split_of

WORLD = "world"
_PLAIN = Rgba(0.7, 0.7, 0.72, 1.0)  # colour of shapes without one


def poses_of(record: RunRecord, bodies: "Bodies") -> Iterator[dict[str, RigidTransform]]:
    """X_WB of each body at the samples of a run, up to the first that is not finite."""
    data, free = record.dataset, free_target(record.dataset)
    hidden = data["hidden_position"].values if "hidden_position" in data else None
    for k, q in enumerate(data["position"].values):
        if not np.isfinite(q).all():
            break
        yield dict(bodies.poses(q, hidden=None if hidden is None else hidden[k], free=free.get(k)))


def joints_of(record: RunRecord) -> tuple[list[str], np.ndarray]:
    """Names of the joints, and their positions, rates and efforts (n, 3, joints)."""
    angles = record.positions().joint_position
    of = {"coordinate": [str(name) for name in angles.coordinate.values]}
    rows = [angles, *(record.dataset[name].sel(of) for name in ("velocity", "applied_force"))]
    return of["coordinate"], np.stack([each.values for each in rows], axis=1)


class Bodies:
    """The bodies of a scenario's model, by scoped name."""

    def __init__(self, scenario: Scenario) -> None:
        builder = self._builder = DiagramBuilder()  # owns what the inspector looks at
        plant = self._plant = add_combined_plant(builder, scenario.model, flexible=True)
        self._inspector = builder.GetSubsystemByName("scene_graph").model_inspector()
        self._context, self._split = plant.CreateDefaultContext(), split_of(plant)
        bodies = [plant.get_body(BodyIndex(k)) for k in range(1, plant.num_bodies())]
        self._bodies = {body.scoped_name().get_full(): body for body in bodies}
        target = find_body(plant, scenario.payload.body, key="payload.body")
        self._target = target.scoped_name().get_full()
        self.base = str(base_body(plant).scoped_name().get_full())

    def pictures(self) -> Iterator[tuple[str, list[tuple[Shape, RigidTransform, Rgba]]]]:
        """Shapes of each body, with their poses in its frame and their colours."""
        look = self._inspector
        for name, body in self._bodies.items():
            frame = self._plant.GetBodyFrameIdOrThrow(body.index())
            yield (
                name,
                [
                    (
                        look.GetShape(each),
                        look.GetPoseInFrame(each),
                        look.GetIllustrationProperties(each).GetPropertyOrDefault(
                            "phong", "diffuse", _PLAIN
                        ),
                    )
                    for each in look.GetGeometries(frame, Role.kIllustration)
                ],
            )

    def poses(
        self,
        q: np.ndarray,
        *,
        hidden: np.ndarray | None = None,
        free: RigidTransform | None = None,
    ) -> Iterator[tuple[str, RigidTransform]]:
        """X_WB of each body in configuration q (nq), with the coordinates of flexible parts; the
        target, if it is ``free``, at that pose.
        """
        self._plant.SetPositions(self._context, self._split.whole_positions(q, hidden))
        for name, body in self._bodies.items():
            is_free = name == self._target and free is not None
            yield name, free if is_free else self._plant.EvalBodyPoseInWorld(self._context, body)
