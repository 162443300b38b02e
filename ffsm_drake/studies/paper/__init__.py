"""Reproduction of the paper: its table and figures recomputed, and a verdict on each claim."""

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
) -> Path:
    """Reproduce the paper, or a part of it, into a directory.

    ``table2`` writes table2.html, .md and .csv; ``fig3`` to ``fig5`` write figures/ as PNG and SVG;
    ``all`` writes these and the summary page, reproduction.html (self-contained) and
    reproduction.md. Each file is written whole.

    Args:
      what: one of ``PARTS``.
      seeds: number of noise seeds, from 0 on; more give a better mean and spread in Table 2.
      overrides: ``key=value`` for every run, as for ``load_scenario``; the page lists them.
      workers, progress: as for ``ffsm_drake.common.workers.map_tasks``; the results do not depend
        on the workers.

    Returns: the main file written.

    Raises:
      FfsmError: an unknown part, an unusable number of seeds or workers, an override that cannot be
        used.
      RecordError: a file cannot be written.
      KeyboardInterrupt: Ctrl-C or SIGTERM during the runs; nothing was written.
    """
    if what not in PARTS:
        raise FfsmError(f"what: '{what}' is unknown; choose one of {', '.join(PARTS)}")
    if seeds < 1:
        raise FfsmError(f"seeds: must be at least 1, not {seeds}")
    if workers < 1:
        raise FfsmError(f"workers: must be at least 1, not {workers}")
    directory = Path(directory)
    # Drawing and templates are slow to import, and PARTS needs neither.
    from ffsm_drake.studies.paper import claims, figures, page, runs, table

    if what in ("table2", "all"):
        cases = runs.table_cases(seeds) if what == "table2" else runs.all_cases(seeds)
    else:
        cases = runs.figure_cases(
            figures.DRAWN, (runs.PROPOSED,) if what == "fig3" else runs.CONTROLLERS
        )
    results = runs.run_cases(
        cases, num_seeds=seeds, overrides=overrides, workers=workers, progress=progress
    )
    if progress is not None:
        progress(len(cases), len(cases), "tables, figures, page")
    if what == "table2":
        return page.write_table(table.make_table(results), results, directory)
    drawing = {
        "fig3": figures.write_figure_3,
        "fig4": figures.write_figure_4,
        "fig5": figures.write_figure_5,
    }
    if what in drawing:
        figure, *_ = drawing[what](results, directory)
        return directory / figures.FOLDER / f"{figure.key}.png"
    rows = table.make_table(results)
    page.write_table(rows, results, directory)
    drawn = [
        figures.write_overview(rows, directory),
        figures.write_divergence(results, directory),
        figures.write_figure_2(directory),
        *[figure for write in drawing.values() for figure in write(results, directory)],
    ]
    return page.write_page(results, rows, drawn, claims.evaluate(results), directory)
