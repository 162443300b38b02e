"""A scenario's control law as C99: a header and a source file.

All memory is the caller's. A sample whose inputs or results are unusable leaves the memory as it
was: the last force is held for a while, then the force is zero.
"""

import dataclasses
import json
from collections.abc import Mapping
from typing import Any

import numpy as np

from ffsm_drake.common.errors import FfsmError
from ffsm_drake.plugins.compiled.apart import Refused, apart, reason_of
from ffsm_drake.plugins.flight.functions import Function, Precision
from ffsm_drake.plugins.flight.header import header_text
from ffsm_drake.plugins.flight.layout import Layout
from ffsm_drake.plugins.flight.source import source_text
from ffsm_drake.plugins.flight.traced import FlightLaw, traced_motion
from ffsm_drake.runs.engine import NotCovered
from ffsm_drake.scenario import HELD, Grip, Scenario
from ffsm_drake.systems.controllers.law import is_shipped
from ffsm_drake.systems.planned_motion import PlannedMotion


@dataclasses.dataclass(frozen=True, kw_only=True)
class LawFiles:
    """The texts of an exported law, and what is known of it."""

    header: str
    source: str
    sizes: Mapping[str, int]  # bytes of each struct
    operations: int  # of a sample
    reference: str  # "polynomial", "table", or "": the caller gives it
    # optional inputs that it reads, of ``LawBlock.inputs``
    reads: tuple[str, ...]

    @classmethod
    def of(
        cls, scenario: Scenario, *, single: bool = False, table: bool = False, header: str = "law.h"
    ) -> "LawFiles":
        """Export the law of a scenario.

        Args:
          scenario: names the law, its gains, estimator, filters, limits and reference.
          single: in single precision.
          table: the reference as a table, even if it is a polynomial.
          header: the header's file name.

        Raises FfsmError: the law cannot be exported; the message names the place in its code.
        """
        precision = Precision(single)
        try:
            grips = (Grip(False), HELD) if scenario.grasps else (HELD,)
            laws = {grip.holds: FlightLaw(scenario, grip) for grip in grips}

            def made() -> str:
                files = _files(scenario, laws, precision, table=table, header=header)
                return json.dumps(dataclasses.asdict(files))

            def made_twice() -> str:
                if (text := made()) != made():
                    raise Refused(
                        "it makes other code when traced again: it draws random numbers, "
                        "reads a clock or keeps values outside its state"
                    )
                return text

            is_own = all(is_shipped(law.law) for law in laws.values())
            return cls(**json.loads(made() if is_own else apart(made_twice)))
        except NotCovered as error:
            raise _refused(scenario, error.what) from error
        except FfsmError:
            raise
        except Exception as error:  # a law may raise anything on symbols
            raise _refused(scenario, reason_of(error)) from error


def _refused(scenario: Scenario, why: str) -> FfsmError:
    return FfsmError(f"controller '{scenario.controller}' cannot be exported as C: {why}")


def _files(
    scenario: Scenario,
    laws: Mapping[bool, FlightLaw],
    precision: Precision,
    *,
    table: bool,
    header: str,
) -> LawFiles:
    samples = {
        holds: (law.sample(precision, is_first=True), law.sample(precision, is_first=False))
        for holds, law in laws.items()
    }
    reads = frozenset(str(name) for of in samples.values() for one in of for name, _ in one.reads)
    layout = Layout(scenario, laws, precision, reads)
    # the motion after a grasp follows from what is measured there
    motions: Mapping[str, PlannedMotion] = {} if layout.captures else layout.law.motions()
    references = {
        field: _reference(motion, precision, layout, table=table)
        for field, motion in motions.items()
        if field == "q_d" or field in reads
    }
    operations = sum(samples[True][1].operations.values())
    kinds = [
        "table" if isinstance(each, np.ndarray) else "polynomial" for each in [*references.values()]
    ]
    return LawFiles(
        header=header_text(
            layout, file=header, operations=operations, has_reference=bool(references)
        ),
        source=source_text(layout, samples, references, header=header),
        sizes=layout.sizes,
        operations=operations,
        reference=max(kinds, default=""),
        reads=tuple(sorted(reads)),
    )


def _reference(
    motion: PlannedMotion, precision: Precision, layout: Layout, *, table: bool
) -> Function | np.ndarray:
    """A motion as a function, or as a table of its control samples."""
    if not table:
        try:
            return traced_motion(motion, precision)
        except Exception:  # NumPy raises many kinds on symbols
            pass
    found: Any = motion.rows(layout.law.times)
    return found
