"""What a verdict costs, as counts: sample maps, loops that are built for them, runs."""

from pathlib import Path

import pytest

from ffsm_drake import load_scenario
from ffsm_drake.plugins.design import verdict as room
from ffsm_drake.plugins.design.stability import margins
from ffsm_drake.plugins.design.verdict import verdict

SHORT = ["duration=2"]


@pytest.fixture(scope="module")
def cost():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(Path(__file__).parents[3] / "benchmarks"))
        import verdict_cost

        yield verdict_cost


# Seven instants each, at the starting gains and at the bounds of K_s; with slow sensors four kinds
# of samples; margins: the five instants at the largest K_s expected, or one at its bounds.
@pytest.mark.parametrize(
    ("name", "maps", "of_margins"),
    [
        ("paper", 14, 5),
        ("flight_sensors", 7, 1),
        pytest.param("slow_navigation", 28, 4, marks=pytest.mark.long),
        pytest.param("reaction_null", 6, 4, marks=pytest.mark.long),
    ],
)
def test_every_loop_is_linearised_once(cost, name, maps, of_margins):
    scenario = load_scenario(name)
    with cost.Counted() as predicted:
        verdict(scenario, rehearsal=False)
    assert 0 < predicted.maps <= maps
    assert predicted.built == 1
    with cost.Counted() as with_margins:
        verdict(scenario, rehearsal=False, margins=True)
    assert with_margins.maps <= maps + of_margins
    assert with_margins.built == 1


@pytest.mark.slow
def test_a_capture_is_linearised_once_for_each_leg(cost):
    with cost.Counted() as counted:
        verdict(load_scenario("tumbling_capture"), rehearsal=False, margins=True)
    assert counted.maps <= 16
    assert counted.built == 2


def test_the_same_instant_and_gains_are_the_same_loop():
    with room.Linearizer(load_scenario("postcapture")) as linearizer:
        gain = linearizer.law.reaching_gain.start
        one, other = (linearizer.at(1.0, held={"reaching_gain": gain.copy()}) for _ in range(2))
        assert one is other
        assert linearizer.at(1.0, held={"reaching_gain": 1.01 * gain}) is not one
        assert linearizer.at(1.01) is not linearizer.at(1.0)


@pytest.mark.long
@pytest.mark.parametrize("with_margins", [False, True])
@pytest.mark.parametrize(("name", "noises"), [("postcapture", 0), ("thrusters_only", 1)])
def test_one_run_and_the_noises_are_rehearsed(name, noises, with_margins, monkeypatch):
    made = []

    def counted(module, what):
        function = getattr(module, what)

        def call(*arguments, **named):
            made.append(what)
            return function(*arguments, **named)

        monkeypatch.setattr(module, what, call)

    counted(room, "make_rollout")
    counted(room, "rehearse")
    counted(margins, "rehearse")
    verdict(load_scenario(name, SHORT), margins=with_margins)
    assert made.count("make_rollout") == 1
    assert made.count("rehearse") == noises


@pytest.mark.long
def test_the_ratios_are_printed(cost, capsys):
    cost.main(["planar_detumble", "--repeats", "1"])
    printed = capsys.readouterr().out
    assert printed.startswith("planar_detumble: run ")
    assert "; validate " in printed
    assert "; stability " in printed
