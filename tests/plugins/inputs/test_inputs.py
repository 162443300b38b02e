"""A run's folder, copied elsewhere without the originals, repeats its run bit for bit."""

import json
import os
import shutil
import sys

import numpy as np
import pytest
import yaml
from click.testing import CliRunner

from ffsm_drake import load_scenario
from ffsm_drake.cli import main
from ffsm_drake.spacecraft.plant import models_dir

DRAWS = int(os.environ.get("FFSM_DRAWS", "2"))
LAW = """import dataclasses
import numpy as np
from {helper} import GAIN
from ffsm_drake import ControlLaw, PlantModel, gain


@dataclasses.dataclass(frozen=True, kw_only=True)
class Mine(ControlLaw):
    model: PlantModel
    k_p: np.ndarray = gain({{"all": 1.0}}, "1/s^2", "on the error")

    def step(self, sample, state):
        wanted = sample.a_d + GAIN * sample.e_dot + self.k_p * sample.e
        q, v = sample.q, sample.v
        return self.model.calc_mass_matrix(q) @ wanted + self.model.calc_bias(q, v), state
"""
CUBE = "v 0 0 0\nv 0.1 0 0\nv 0 0.1 0\nv 0 0 0.1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n"
MESH = '<visual><geometry><mesh filename="{}"/></geometry></visual></link>'


def draw(seed, folder):
    """A project with a scenario, its file, and the names of the files that its run needs."""
    random = np.random.default_rng(seed)
    pick = random.choice
    files, data = {}, {"duration": 0.03}
    mesh = pick(["none", "relative", "package"])
    name = {
        "none": "",
        "relative": "../shapes/cube.obj",
        "package": "package://lab/shapes/cube.obj",
    }
    urdfs = {}
    for each in ("servicer", "debris"):
        text = (models_dir() / f"urdf/{each}.urdf").read_text()
        shape = MESH.format(name[str(mesh)]) if mesh != "none" and each == "debris" else "</link>"
        urdfs[each] = text.replace("</link>", shape, 1)
    model = pick(["shipped", "urdf", "directives", "plan"])
    if model in ("urdf", "directives"):
        files |= {f"lab/urdf/{each}.urdf": text for each, text in urdfs.items()}
        files |= {"lab/shapes/cube.obj": CUBE} if mesh != "none" else {}
        data["model"] = {"packages": {"lab": "lab"}} if mesh == "package" else {}
    if model == "urdf":
        paths = {each: f"lab/urdf/{each}.urdf" for each in urdfs}
        data["model"] |= paths | {"grasp": "debris::grasp"}
    if model == "directives":
        data["model"] |= {"directives": "lab/craft.dmd.yaml", "packages": {"lab": "lab"}}
        text = (models_dir() / "postcapture.dmd.yaml").read_text()
        files["lab/craft.dmd.yaml"] = text.replace("ffsm_drake", "lab")
    if model == "plan":
        data["extends"] = "planar_detumble"
        data["reference"] = {"plan": "plans/turn.yaml"}
        files["plans/turn.yaml"] = (models_dir() / "plans/planar_detumble.yaml").read_text()
    law = pick(["none", "beside", "folder", "package"])
    unique = f"{folder.parent.name}_{seed}".replace("-", "_")
    if law != "none":
        place = {"beside": "", "folder": "laws/", "package": f"pack_{unique}/sub/"}[str(law)]
        helper = f"gains_{unique}" if law != "package" else f"..gains_{unique}"
        files[f"{place}law_{unique}.py"] = LAW.format(helper=helper)
        up = f"pack_{unique}/" if law == "package" else place
        files[f"{up}gains_{unique}.py"] = "GAIN = 2.0\n"
        module = f"law_{unique}"
        if law == "package":
            module = f"pack_{unique}.sub.{module}"
            files |= {f"pack_{unique}/{each}__init__.py": "" for each in ("", "sub/")}
        data |= {"controller": f"{module}:Mine", "python_path": ["laws"] if law == "folder" else []}
    needed = {name for name in files if not name.endswith("unused.py")}
    files["unused.py"] = "raise SystemExit\n"
    for file, text in files.items():
        (folder / file).parent.mkdir(parents=True, exist_ok=True)
        (folder / file).write_text(text)
    if pick([True, False]):  # a chain, from another folder
        (folder / "base.yaml").write_text(yaml.safe_dump(data))
        (folder / "deep").mkdir()
        data = {"extends": "../base.yaml", "random_seed": 3}
    file = folder / ("deep/mine.yaml" if "random_seed" in data else "mine.yaml")
    file.write_text(yaml.safe_dump(data))
    return file, needed


def ffsm(*words):
    done = CliRunner().invoke(main, [str(word) for word in words])
    assert done.exit_code == 0, (done.output, done.stderr)
    return done


def forget(unique):
    """Forget the modules of a project, as another process would."""
    for name in [each for each in sys.modules if unique in each]:
        del sys.modules[name]


@pytest.mark.slow
def test_a_folder_repeats_its_run_without_the_originals(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "path", list(sys.path))
    kept = 0
    for seed in range(DRAWS):
        project = tmp_path / f"project_{seed}"
        project.mkdir()
        file, needed = draw(seed, project)
        monkeypatch.chdir(project)
        sys.path[:] = [each for each in sys.path if "project_" not in each]
        run = ("run", file, "--no-report", "--out", project / "out")
        ffsm(*run)
        again = ffsm(*run)  # its own record, whose paths lead to the copies, has the same settings
        assert "other settings" not in again.stderr
        inputs = json.loads((project / "out/manifest.json").read_text()).get("inputs", {})
        names = {name.removeprefix("record.inputs/") for name in inputs.get("files", {})}
        ends = {tuple(name.split("/")[-2:]) for name in names}
        assert len(names) == len(needed), (names, needed)
        assert all(tuple(n.split("/")[-2:])[-1:] in {e[-1:] for e in ends} for n in needed)
        kept += bool(names)
        away = tmp_path / f"elsewhere_{seed}"
        shutil.copytree(project / "out", away / "run")
        forget(f"_{seed}")
        project.rename(tmp_path / f"gone_{seed}")
        monkeypatch.chdir(away)
        sys.path[:] = [each for each in sys.path if "project_" not in each]
        said = ffsm("run", away / "run", "--no-report", "--out", away / "again").output
        assert f"same record, bit for bit: {away / 'run'}" in said
        assert {*json.loads((away / "again/manifest.json").read_text()).get("inputs", {})} == {
            *inputs
        }
        forget(f"_{seed}")
    assert kept > DRAWS / 2


def project_with_a_law(tmp_path, monkeypatch):
    """The first drawn project that has models and a law of its own, and its run's folder."""
    monkeypatch.setattr(sys, "path", list(sys.path))
    for seed in range(1000, 1100):
        project = tmp_path / f"at_{seed}"
        project.mkdir()
        file, needed = draw(seed, project)
        if len(needed) == 5 and any(name.startswith("laws/") for name in needed):
            break
    monkeypatch.chdir(project)
    return project, file, f"_{seed}"


@pytest.mark.long
def test_a_changed_or_missing_file_is_named(tmp_path, monkeypatch):
    project, file, unique = project_with_a_law(tmp_path, monkeypatch)
    ffsm("run", file, "--no-report", "--out", "out")
    load_scenario("out")  # in this process the law is loaded from its own place
    ffsm("run", "out", "--no-report", "--out", "again")
    law = next((project / "out/record.inputs").rglob("law_*.py"))
    law.write_text(law.read_text().replace("GAIN * sample", "1.1 * GAIN * sample"))
    forget(unique)
    said = ffsm("run", "out", "--no-report", "--out", "other")
    assert f"warning: {os.path.relpath(law)}: was changed after the run" in said.stderr.replace(
        f"{project}/", ""
    )
    assert "different record" in said.output
    law.unlink()
    shown = CliRunner().invoke(main, ["plot", "out"])
    assert "is missing, so the folder does not repeat its run" in shown.stderr
    # a later run without such files leaves none behind
    ffsm("run", "postcapture", "--set", "duration=0.02", "--no-report", "--out", "out")
    assert not (project / "out/record.inputs").exists()


@pytest.mark.smoke
@pytest.mark.parametrize("name", ["../../secret", "/etc/passwd", "record.inputs/../../x"])
def test_names_that_lead_out_of_the_folder_are_not_read(name, tmp_path):
    from ffsm_drake.plugins.inputs.keeping import changed_inputs

    assert not list(changed_inputs(tmp_path, {"files": {name: "0"}}))
    for other in (None, [], {"files": 3}, {"files": {}}):
        assert not list(changed_inputs(tmp_path, other))
