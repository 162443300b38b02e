"""The law in the minor steps of an integrator: the same loop as Drake's where both do the same."""

import pytest

from ffsm_drake import load_scenario, simulate
from ffsm_drake.plugins.paper.minor_steps import (
    BOGACKI_SHAMPINE,
    EULER,
    HEUN,
    RUNGE_KUTTA,
    minor_step_runs,
    minor_step_table,
    run,
)

QUIET = ("sensing.velocity_noise=0", "duration=2")


@pytest.mark.parametrize(
    ("scheme", "held", "overrides", "tolerance"),
    [
        (EULER, False, (), 1e-9),
        (RUNGE_KUTTA, True, ("simulator_config.integration_scheme=runge_kutta3",), 1e-5),
    ],
)
def test_the_loop_is_the_simulations(scheme, held, overrides, tolerance):
    """A scheme without minor steps, and a force held over the period, are what the closed loop
    does.
    """
    made = run(load_scenario("paper", QUIET), scheme, held=held)
    record = simulate(load_scenario("paper", [*QUIET, *overrides]), check_stability=False)
    assert made.itae == pytest.approx(record.metrics["itae"], rel=tolerance)
    assert made.isv == pytest.approx(record.metrics["isv"], rel=tolerance)
    assert made.largest_k_s == pytest.approx(record.dataset["reaching_gain"].values.max(), rel=1e-2)


@pytest.mark.smoke
def test_minor_steps_change_the_force():
    scenario = load_scenario("paper", QUIET)
    assert run(scenario, RUNGE_KUTTA).itae > 1.1 * run(scenario, RUNGE_KUTTA, held=True).itae


@pytest.mark.long
def test_where_the_published_gains_complete():
    """Without a held force it depends on the scheme; with one, the gain leaves the sampled loop's
    limit of 100 1/s.
    """
    made = {(one.scheme, one.held): one for one in minor_step_runs()}
    completing = [key for key, one in made.items() if one.diverged is None]
    assert completing == [(EULER, False), (BOGACKI_SHAMPINE, False), (RUNGE_KUTTA, False)]
    assert 4.0 < made[RUNGE_KUTTA, True].diverged < 8.0
    assert made[RUNGE_KUTTA, True].largest_k_s > 100.0
    assert 4.0 < made[HEUN, False].diverged < 8.0
    assert made[EULER, False].isv == pytest.approx(393.9, rel=0.01)  # Table 2
    _, rows = minor_step_table()
    assert [row[2].split()[0] for row in rows] == [
        "completes",
        "diverges",
        "completes",
        "completes",
        "diverges",
    ]
    assert rows[3][4:] == [
        f"{made[RUNGE_KUTTA, False].isv:.1f}",
        f"{made[RUNGE_KUTTA, False].largest_k_s:.1f}",
    ]
