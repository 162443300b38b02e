"""Masses, inertias and limits of model files: drawn files, compared with Drake and MuJoCo."""

import logging
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant

from ffsm_drake.plugins.new.urdf import read_urdf, write_urdf

DRAWS = [6, pytest.param(500, marks=pytest.mark.exhaustive)]
INERTIAL = (
    "<inertial><mass>8</mass><inertia><ixx>0.5</ixx><iyy>0.4</iyy><izz>0.2</izz></inertia>"
    "</inertial>"
)


def numbers(values: object) -> str:
    return " ".join(map(repr, np.ravel(values).tolist()))


def mass_matrix(file: Path) -> np.ndarray:
    """H of a model with one joint, in one configuration, by Drake alone."""
    plant = MultibodyPlant(time_step=0.0)
    Parser(plant).AddModels(str(file))
    plant.Finalize()
    context = plant.CreateDefaultContext()
    plant.SetPositions(context, [1, 0, 0, 0, 0, 0, 0, 0.4])
    return plant.CalcMassMatrix(context)


# libsdformat's automatic inertia


def shapes(rng: np.random.Generator, mesh: Path) -> Iterator[str]:
    """Collision shapes of a link, with poses and densities."""
    for k in range(rng.integers(1, 4)):
        a, b, c = rng.uniform(0.05, 0.9, 3).tolist()
        geometry = rng.choice([
            f"<box><size>{a} {b} {c}</size></box>", f"<sphere><radius>{a}</radius></sphere>",
            f"<cylinder><radius>{a}</radius><length>{b}</length></cylinder>",
            f"<capsule><radius>{a}</radius><length>{b}</length></capsule>",
            f"<ellipsoid><radii>{a} {b} {c}</radii></ellipsoid>",
            f"<cone><radius>{a}</radius><length>{b}</length></cone>",
            f"<mesh><uri>{mesh.name}</uri><scale>{a} {b} {c}</scale></mesh>",
        ])  # fmt: skip
        density = f"<density>{rng.uniform(5, 900)}</density>" * bool(rng.random() < 0.5)
        surface = "<surface><friction><ode><mu>3</mu></ode></friction></surface>"
        yield (
            f'<collision name="c{k}"><pose>{numbers(rng.normal(size=6))}</pose><geometry>'
            f"{geometry}</geometry>{density}{surface * bool(rng.random() < 0.3)}</collision>"
        )


@pytest.mark.parametrize("draws", DRAWS)
def test_automatic_inertia_is_drakes(draws: int, tmp_path: Path) -> None:
    corners = [(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)]
    faces = "1 2 4,1 4 3,5 8 6,5 7 8,1 6 2,1 5 6,3 4 8,3 8 7,1 3 7,1 7 5,2 6 8,2 8 4".split(",")
    mesh, file = tmp_path / "block.obj", tmp_path / "craft.sdf"
    lines = [f"v {numbers(corner)}" for corner in corners] + [f"f {face}" for face in faces]
    mesh.write_text("\n".join(lines))
    rng, log = np.random.default_rng(21), logging.getLogger("drake")
    for draw in range(draws):
        inside = f"<density>{rng.uniform(5, 900)}</density>" * bool(rng.random() < 0.4)
        inside += f"<mass>{rng.uniform(5, 900)}</mass>" * bool(rng.random() < 0.3)
        text = (
            '<sdf version="1.11"><model name="craft"><link name="bus">'
            f'<inertial auto="{rng.choice(["true", "1"])}">{inside}</inertial>'
            f"{''.join(shapes(rng, mesh))}</link>"
            f'<link name="arm"><pose>0 0 1 0 0 0</pose>{INERTIAL}</link><joint name="j" '
            'type="revolute"><parent>bus</parent><child>arm</child><axis><xyz>0 1 0</xyz></axis>'
            "</joint></model></sdf>"
        )
        file.write_text(text)
        alone = tmp_path / "alone.sdf"  # Drake does not find a relative mesh
        alone.write_text(text.replace(f"<uri>{mesh.name}", f"<uri>{mesh}"))
        log.disabled = True  # it warns of what libsdformat has used
        expected = mass_matrix(alone)
        log.disabled = False
        write_urdf(read_urdf(file), tmp_path, file_name="craft.urdf", packages={})
        found = mass_matrix(tmp_path / "craft.urdf")
        np.testing.assert_allclose(
            found, expected, rtol=0.0, atol=1e-12 * expected.max(), err_msg=f"{draw}: {text}"
        )
