"""What a model draws of its panels moves with their plates."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from pydrake.geometry import Role
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.framework import DiagramBuilder

from ffsm_drake.scenario import Flexible, Model, Posture
from ffsm_drake.spacecraft.plant import add_combined_plant, configuration, coordinates_of, split_of

HINGE = np.array([0.0, 1.0, 0.0])
DRAWN = 22  # shapes of the shipped servicer's port panel; its boom is the base's


def shapes(model, *, flexible=True, deflection=None):
    """Name -> (body, X_WG) of all that is drawn with the base at the origin, and at which body."""
    builder = DiagramBuilder()
    plant = add_combined_plant(builder, model, flexible=flexible)
    inspector = builder.GetSubsystemByName("scene_graph").model_inspector()
    builder.Build()
    context = plant.CreateDefaultContext()
    q = configuration(coordinates_of(plant), Posture(), key="posture")
    plant.SetPositions(context, split_of(plant).whole_positions(q, deflection))
    found = {}
    for geometry in inspector.GetAllGeometryIds(Role.kIllustration):
        body = plant.GetBodyFromFrameId(inspector.GetFrameId(geometry))
        found[inspector.GetName(geometry)] = (
            body.name(),
            body.EvalPoseInWorld(context) @ inspector.GetPoseInFrame(geometry),
        )
    return found


def port(**changes):
    return Model(flexible={"port": Flexible(position=HINGE.tolist(), frequency=0.25, **changes)})


@pytest.mark.smoke
def test_the_panel_swings_and_the_rest_stays():
    rigid, angle = shapes(Model(), flexible=False), 0.2
    bent = shapes(port(), deflection=np.array([angle]))
    assert bent.keys() == rigid.keys()  # no plate is drawn over the panel
    swing = RigidTransform(RotationMatrix.MakeXRotation(angle), HINGE) @ RigidTransform(-HINGE)
    moved = {name for name, (body, _) in bent.items() if body == "port"}
    assert len(moved) == DRAWN
    for name, (_, X_WG) in bent.items():
        expected = swing @ rigid[name][1] if name in moved else rigid[name][1]
        assert_allclose(X_WG.GetAsMatrix4(), expected.GetAsMatrix4(), atol=1e-12)
    drawn = [rigid[name][1].translation() for name in moved]
    assert min(place[1] for place in drawn) > 1.1  # the boom, at 0.85 m, is the base's
    assert max(abs(place[0]) for place in drawn) < 0.5


@pytest.mark.parametrize(("plates", "of_the_model"), [(2, True), (3, True), (8, False)])
def test_a_shape_goes_with_the_plate_that_is_nearest(plates, of_the_model):
    rigid, chain = shapes(Model(), flexible=False), shapes(port(plates=plates))
    length = 3.0 / plates
    for name, (body, X_WG) in chain.items():
        if body.startswith("port_"):
            center = (int(body.removeprefix("port_")) - 0.5) * length + HINGE[1]
            # The last panel of the model reaches beyond the plates.
            assert (
                abs(X_WG.translation()[1] - center) <= 0.5 * length + 0.05
                or body == f"port_{plates}"
            )
            assert (name in rigid) == of_the_model
    on_plates = {body for body, _ in chain.values() if body.startswith("port_")}
    assert len(on_plates) == plates
    # Shapes too long to bend make way for plates; those of the other side are left.
    gone = rigid.keys() - chain.keys()
    assert len(gone) == (0 if of_the_model else DRAWN)


def test_a_panel_elsewhere_is_drawn_as_a_plate():
    # There are thrusters' nozzles beside its root, which stay where they are.
    model = Model(
        flexible={
            "fin": Flexible(position=[0.0, 0.0, -1.0], direction=[0.0, 0.0, -1.0], frequency=1.0)
        }
    )
    found = shapes(model)
    assert [name for name, (body, _) in found.items() if body == "fin"] == ["flexible::fin_visual"]
    assert len(found) == len(shapes(Model(), flexible=False)) + 1
