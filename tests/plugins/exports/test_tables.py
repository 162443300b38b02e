"""A run's files for other programs hold what its record holds."""

import shutil

import numpy as np
import pandas as pd
import pytest
from children import finished
from click.testing import CliRunner
from scipy.io import loadmat

from ffsm_drake import RunRecord, load_scenario, simulate
from ffsm_drake.cli import main


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    simulate(load_scenario("postcapture", ["duration=0.3"]), check_stability=False).save(folder)
    return folder


def exported(folder, path):
    result = CliRunner().invoke(main, ["export", str(path), str(folder)])
    assert result.exit_code == 0, result.output
    return path


@pytest.mark.smoke
@pytest.mark.parametrize("ending", ["csv", "parquet"])
def test_table_holds_the_record(folder, tmp_path, ending):
    if ending == "parquet":
        pytest.importorskip("pyarrow")
    path = exported(folder, tmp_path / f"run.{ending}")
    table = pd.read_csv(path) if ending == "csv" else pd.read_parquet(path)
    data = RunRecord.load(folder).dataset
    for number, name in enumerate(data.coordinate.values):
        own = table[f"velocity.{name}"]
        np.testing.assert_allclose(own, data.velocity.values[:, number], rtol=1e-14)


@pytest.mark.smoke
def test_mat_holds_the_record_with_units(folder, tmp_path):
    path = exported(folder, tmp_path / "run.mat")
    run = loadmat(path, simplify_cells=True)["run"]
    data = RunRecord.load(folder).dataset
    np.testing.assert_array_equal(run["velocity"]["values"], data.velocity.values)
    assert run["time"]["units"] == "s"
    assert list(run["coordinate"]["values"]) == list(data.coordinate.values)


def test_other_endings_are_refused(folder, tmp_path):
    result = CliRunner().invoke(main, ["export", str(tmp_path / "run.xyz"), str(folder)])
    assert result.exit_code == 2
    for option in (["--ros2"], ["--part", "controller"]):
        line = ["export", str(tmp_path / "run.csv"), str(folder), *option]
        assert f"{option[0]}: not for a .csv" in CliRunner().invoke(main, line).output
    assert "must end in .aem, .csv, .mat, .mcap, .oem, .parquet, .c, .fmu" in result.output


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("octave-cli") is None, reason="needs Octave (apt install octave)")
def test_octave_reads_the_mat_file(folder, tmp_path):
    path = exported(folder, tmp_path / "run.mat")
    asked = f"""
        load("{path}");
        printf("%d ", size(run.velocity.values));
        printf("%s %s ", run.time.units, run.coordinate.values{{7}});
        printf("%.17g", run.velocity.values(end, 7));
    """
    line = ["octave-cli", "--no-init-file", "--quiet", "--eval", asked]
    said = finished(line, check=True).stdout
    data = RunRecord.load(folder).dataset
    rows, columns, unit, name, value = said.split()
    assert (int(rows), int(columns)) == data.velocity.shape
    assert (unit, name) == ("s", str(data.coordinate.values[6]))
    assert float(value) == data.velocity.values[-1, 6]
