"""The paper with one command: its table and figures computed anew, and a verdict on each of its claims."""

from collections.abc import Callable, Sequence
from pathlib import Path

from ffsm_drake.common.errors import FfsmError

PARTS = ("table2", "fig3", "fig4", "fig5", "all")

__all__ = ["PARTS", "reproduce"]


def reproduce(
    what: str,
    directory: str | Path,
    *,
    seeds: int = 3,
    overrides: Sequence[str] = (),
    workers: int = 1,
    progress: Callable[[int, int, str], None] | None = None,
) -> Path | None:
    """Compute a part of the paper, or all of it, and write it into a directory, each file whole.

    ``table2`` writes table2.html, .md and .csv; ``fig3`` to ``fig5`` write figures/ as PNG and SVG; ``all`` writes
    these and the page that gathers everything, reproduction.html (self-contained) and reproduction.md.

    Args:
      what: one of ``PARTS``.
      seeds: how many seeds of the measurement noise, from 0 on; more give a better mean and spread in Table 2.
      overrides: ``key=value`` for every run, as for ``load_scenario``; the page says that they were given.
      workers: processes that simulate; beyond one they are spawned, so a script must call this under
        ``if __name__ == "__main__":``. The results do not depend on their number.
      progress: called with (runs done, runs in all, what is next).

    Returns: the main file written, or None when interrupted from the keyboard during the runs: then nothing is written.

    Raises:
      FfsmError: an unknown part, an unusable number of seeds or workers, an override that cannot be used.
      RecordError: a file cannot be written.
    """
    if what not in PARTS:
        raise FfsmError(f"what: '{what}' is unknown; choose one of {', '.join(PARTS)}")
    if seeds < 1:
        raise FfsmError(f"seeds: must be at least 1, not {seeds}")
    if workers < 1:
        raise FfsmError(f"workers: must be at least 1, not {workers}")
    directory = Path(directory)
    # Drawing and templates are slow to import, and whoever only asks for PARTS needs neither.
    from ffsm_drake.studies.paper import claims, figures, page, runs, table

    cases = {
        "table2": lambda: runs.table_cases(seeds),
        "all": lambda: runs.all_cases(seeds),
    }.get(what, runs.figure_cases)()
    try:
        results = runs.run_cases(cases, num_seeds=seeds, overrides=overrides, workers=workers, progress=progress)
    except KeyboardInterrupt:
        return None
    if progress is not None:
        progress(len(cases), len(cases), "tables, figures, page")
    if what == "table2":
        return page.write_table(table.make_table(results), results, directory)
    drawing = {"fig3": figures.write_figure_3, "fig4": figures.write_figure_4, "fig5": figures.write_figure_5}
    if what in drawing:
        return drawing[what](results, directory)[0].png
    rows = table.make_table(results)
    page.write_table(rows, results, directory)
    drawn = [
        figures.write_overview(rows, directory),
        figures.write_divergence(results, directory),
        figures.write_figure_2(directory),
        *[figure for write in drawing.values() for figure in write(results, directory)],
        *([] if overrides else [figures.write_noise(directory, workers=workers, progress=progress)]),
    ]
    return page.write_page(results, rows, drawn, claims.judge(results), directory)
