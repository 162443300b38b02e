"""``ffsm doctor``: what is there, and what is not."""

import json
from importlib.metadata import version

import pytest
from click.testing import CliRunner

from ffsm_drake.cli import main


def ffsm(*words):
    return CliRunner().invoke(main, words)


@pytest.mark.smoke
def test_doctor(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = ffsm("doctor", "--json")
    assert result.exit_code == 0, result.output
    status = {check["name"]: check["status"] for check in json.loads(result.stdout)}
    assert status["a short run"] == "ok"
    assert not list(tmp_path.iterdir())

    def no_models():
        raise OSError("no models")

    monkeypatch.setattr("ffsm_drake.spacecraft.plant.models_dir", no_models)
    sick = ffsm("doctor")
    assert sick.exit_code == 2
    assert "[missing] models: no models" in sick.stdout


@pytest.mark.parametrize(
    ("tested", "status"),
    [
        (("1.0.0", "999.0.0"), "ok"),
        # the installed one is newer, though "1.9" comes after "1.51" as text
        (("1.0.0", "1.9.9"), "remark"),
        (("999.0.0", "999.1.0"), "remark"),
    ],
)
def test_doctor_remarks_on_an_untested_drake(tested, status, monkeypatch):
    monkeypatch.setattr("ffsm_drake.common.versions.TESTED_DRAKE", tested)
    result = ffsm("doctor", "--json")
    assert result.exit_code == 0
    (check,) = [check for check in json.loads(result.stdout) if check["name"] == "Drake"]
    assert check["status"] == status
    assert version("drake") in check["detail"]
    assert all(end in check["detail"] for end in tested)
