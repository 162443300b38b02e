"""Inertias with the rounding of a CAD program: one rule decides on every way in."""

import os
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ffsm_drake.common.errors import ModelError
from ffsm_drake.scenario import Model
from ffsm_drake.spacecraft.inertia import MOMENTS, SIX
from ffsm_drake.spacecraft.plant import make_plant

DRAWS = int(os.environ.get("FFSM_DRAWS", "8"))
TARGET = (
    '<robot name="target"><link name="debris"><inertial><mass value="2"/><inertia ixx="1" iyy="1" '
    'izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link><frame name="grasp" link="debris"/></robot>'
)


def drawn(rng: np.random.Generator, excess: float) -> np.ndarray:
    """Ixx to Iyz of a turned rod, plate or solid, kg m^2; ``excess``: the share by which the
    largest principal moment exceeds the sum of the others.
    """
    one, other = sorted(10.0 ** rng.uniform(-6.0, 3.0, 2))
    low, middle = ((0.0, one), (one, one), (one, other))[rng.integers(3)]
    moments = np.array([low, middle, (low + middle) * (1.0 + excess)])
    turn = Rotation.random(random_state=int(rng.integers(1 << 30))).as_matrix()
    noise = 1e-17 * rng.normal(size=(3, 3))
    matrix = (turn * moments) @ turn.T + noise + noise.T
    return 0.5 * (matrix + matrix.T)


def model_of(folder: Path, inertia: np.ndarray, kind: str) -> Model:
    """A servicer whose arm has an inertia, named by its URDF or in directives."""
    moments = " ".join(
        f'{key}="{value!r}"' for key, value in zip(MOMENTS, inertia[SIX].tolist(), strict=True)
    )
    (folder / "craft.urdf").write_text(
        '<robot name="craft" xmlns:drake="http://drake.mit.edu"><!--\n--><link name="bus">'
        '<inertial><mass value="8"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>'
        f'</inertial></link><link name="arm"><inertial><mass value="8"/><inertia {moments}/>'
        '</inertial><visual><geometry><mesh filename="sub/m.obj"/></geometry></visual></link>'
        '<joint name="j" type="continuous"><parent link="bus"/><child link="arm"/><axis '
        'xyz="0 1 0"/></joint><transmission name="t"><type>transmission_interface/'
        'SimpleTransmission</type><joint name="j"/><actuator name="d"><drake:rotor_inertia '
        'value="0.5"/><drake:gear_ratio value="1"/></actuator></transmission></robot>'
    )
    (folder / "target.urdf").write_text(TARGET)
    frames = {"end_effector": "servicer::arm", "grasp": "debris::grasp"}
    if kind == "urdf":
        files = {"servicer": str(folder / "craft.urdf"), "debris": str(folder / "target.urdf")}
        return Model(**files, **frames)
    inner, outer = folder / "craft.dmd.yaml", folder / "all.dmd.yaml"
    inner.write_text(
        "directives:\n- add_model: {name: servicer, file: package://here/craft.urdf}\n"
        "- add_model: {name: debris, file: package://here/target.urdf}\n"
        "- add_weld: {parent: servicer::arm, child: debris::grasp}\n"
    )
    outer.write_text("directives:\n- add_directives: {file: package://here/craft.dmd.yaml}\n")
    name = {"directives": inner, "nested": outer}[kind]
    return Model(directives=str(name), packages={"here": str(folder)}, **frames)


@pytest.mark.parametrize("kind", ["urdf", "directives", "nested"])
def test_rounding_is_no_fault(kind, tmp_path):
    rng = np.random.default_rng(5)
    for _ in range(DRAWS if kind == "urdf" else 2):
        inertia = drawn(rng, rng.choice([0.0, 1e-15, 1e-12, 5e-10]))
        plant = make_plant(model_of(tmp_path, inertia, kind))
        arm = plant.GetBodyByName("arm").default_rotational_inertia().CopyToFullMatrix3()
        np.testing.assert_allclose(arm, inertia, rtol=0.0, atol=2e-9 * np.abs(inertia).max())
        assert plant.GetJointActuatorByName("d").default_rotor_inertia() == 0.5


@pytest.mark.parametrize("kind", ["urdf", "directives", "nested"])
def test_an_inertia_of_no_body_is_refused(kind, tmp_path):
    rng = np.random.default_rng(6)
    for _ in range(DRAWS if kind == "urdf" else 1):
        model = model_of(tmp_path, drawn(rng, 10.0 ** rng.uniform(-8.5, 0.0)), kind)
        with pytest.raises(ModelError, match=r"craft\.urdf.*arm") as error:
            make_plant(model)
        assert "\n" not in str(error.value)
