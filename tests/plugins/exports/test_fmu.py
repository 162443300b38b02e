"""The plant of a scenario as an FMU."""

import pytest

from ffsm_drake import FfsmError, load_scenario

pytest.importorskip("pythonfmu3", reason="needs pythonfmu3, of the extra fmu")

from ffsm_drake.plugins.exports.fmu import export


@pytest.mark.parametrize(
    ("name", "override", "said"),
    [
        ("tumbling_capture", "duration=30", "capture: "),
        ("two_arms", "contacts.right.closes=2", "contacts: hands that close later"),
    ],
)
def test_a_capture_or_a_late_hand_is_refused(tmp_path, name, override, said):
    with pytest.raises(FfsmError, match=said):
        export(load_scenario(name, [override]), tmp_path / "plant.fmu")
