"""Reproduction of the paper's table and figures, with a verdict on each claim."""

from collections.abc import Callable, Sequence
from functools import partial
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
    tell: Callable[[str], None] | None = None,
) -> Path:
    """Reproduce the paper, or a part of it, into a directory; returns the main file written.

    ``table2`` writes table2.html, .md and .csv; ``fig3`` to ``fig5`` write figures/ as PNG and SVG;
    ``all`` writes these and the summary page, reproduction.html (self-contained) and
    reproduction.md. Each file is written whole.

    Args:
      what: one of ``PARTS``.
      seeds: number of noise seeds, from 0 on; more give a better mean and spread in Table 2.
      overrides: ``key=value`` for every run (see ``load_scenario``); the page lists them.
      workers, progress: see ``ffsm_drake.plugins.workers.pool.map_tasks``.
      tell: called with what is reproduced of Table 2, what is not, and what was chosen, as text.

    Raises:
      FfsmError: an unknown part, no seeds or workers, or an unusable override.
      RecordError: a file cannot be written.
      KeyboardInterrupt: Ctrl-C or SIGTERM during the runs; nothing was written.
    """
    _check(what, seeds=seeds, workers=workers)
    directory = Path(directory)
    # Drawing and templates are slow to import, and PARTS needs neither.
    from ffsm_drake.plugins.paper import claims, figures, outcome, page, runs, table

    drawing: dict[str, Callable[..., list[figures.FigureFile]]] = {
        "fig3": figures.write_figure_3,
        **{key: partial(figures.write_overlaid, key=key) for key in ("fig4", "fig5")},
    }
    if what in drawing:
        shown = (runs.PROPOSED,) if what == "fig3" else runs.CONTROLLERS
        cases = runs.figure_cases(figures.DRAWN, shown)
    else:
        cases = runs.table_cases(seeds) if what == "table2" else runs.all_cases(seeds)
    results = runs.run_cases(
        cases, num_seeds=seeds, overrides=overrides, workers=workers, progress=progress
    )
    if progress is not None:
        progress(len(cases), len(cases), "tables, figures, page")
    if what in drawing:
        figure, *_ = drawing[what](results, directory)
        return directory / figures.FOLDER / f"{figure.key}.png"
    rows = table.make_table(results)
    table_file = page.write_table(rows, results, directory)
    if tell is not None:
        tell(outcome.outcome_text(rows))
    if what == "table2":
        return table_file
    drawn = [
        figures.write_overview(rows, directory),
        figures.write_divergence(results, directory),
        figures.write_figure_2(directory),
        *[figure for write in drawing.values() for figure in write(results, directory)],
    ]
    return page.write_page(results, rows, drawn, claims.evaluate(results), directory)


def _check(what: str, **counts: int) -> None:
    if what not in PARTS:
        raise FfsmError(f"what: '{what}' is unknown; choose one of {', '.join(PARTS)}")
    for name, count in counts.items():
        if count < 1:
            raise FfsmError(f"{name}: must be at least 1, not {count}")
