"""The command plan."""

from pathlib import Path
from typing import TYPE_CHECKING

import click

from ffsm_drake.cli.common import (
    FiniteFloat,
    json_option,
    out_option,
    print_result,
    scenario_options,
    scenario_stem,
)

if TYPE_CHECKING:
    from ffsm_drake.scenario import Scenario


@click.command()
@scenario_options
@out_option(help="Folder for plan.yaml and plan.png (default: out/<scenario>_plan).")
@click.option(
    "--time",
    "time_limit",
    type=FiniteFloat(min=0.0, min_open=True),
    default=300.0,
    show_default=True,
    help="Time limit of the search, s; then the best plan within every limit is used.",
)
@json_option
def plan(scenario: "Scenario", out: Path | None, time_limit: float, as_json: bool) -> None:
    """Plan the least-time or least-effort motion to rest within every limit.

    'planning' in SCENARIO sets the goal. Takes seconds to minutes. Prints the plan's duration and
    effort, and the used share of each limit. With reference.kind 'optimal' the plan is also written
    to the file reference.plan, and 'run' follows it. Exits with 2 if no motion keeps every limit,
    and names the active one. The last lines are the verdict on a run along the plan.

    \b
    Examples:
      ffsm plan planar_detumble
      ffsm plan mine.yaml --set reference.goal=stop --set planning.effort_weight=0.1
      ffsm run mine.yaml --set reference.kind=optimal --set reference.plan=out/mine_plan/plan.yaml
    """
    from ffsm_drake.common.files import check_writable
    from ffsm_drake.plugins.design.verdict import verdict
    from ffsm_drake.plugins.planning.figure import plot_plan
    from ffsm_drake.plugins.planning.planner import plan_motion
    from ffsm_drake.plugins.planning.tables import plan_data, plan_table
    from ffsm_drake.scenario import override_scenario
    from ffsm_drake.show.figures.axes import save_figure
    from ffsm_drake.systems.controllers import declared_gains

    directory = out or Path("out") / f"{scenario_stem()}_plan"
    check_writable(directory)
    declared_gains(scenario)  # an unknown controller is refused before the search
    found = plan_motion(
        scenario, progress=lambda line: click.echo(line, err=True), time_limit=time_limit
    )
    title = f"{scenario.description}\nMade by 'ffsm plan'; read by reference.plan."
    files = [directory / "plan.yaml"]
    named = scenario.reference.plan
    if scenario.reference.kind == "optimal" and named is not None and "://" not in named:
        files.append(Path(named))
    for file in files:
        found.plan.save(file, title=title)
    figure, names = directory / "plan.png", list(map(str, files))
    save_figure(plot_plan(found, scenario), figure)
    reference = {"kind": "optimal", "plan": str(files[0].resolve()), "shaper": None}
    mission = verdict(override_scenario(scenario, [{"reference": reference}]))
    told = "\n".join([*mission.lines, mission.conclusion])
    print_result(
        as_json,
        plan_data(found) | {"files": names, "mission": mission.as_data()},
        f"{plan_table(found)}\n\n{told}\n\nWritten to {', '.join(names)}; {figure}",
    )
