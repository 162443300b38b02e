"""Copies of the files that a run is made from, in its folder."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any, Protocol

from ffsm_drake.common.registrations import Registry
from ffsm_drake.scenario import Scenario


class InputCopies(Protocol):
    """Keeps the files that a run is made from."""

    def keep(self, scenario: Scenario, folder: Path) -> dict[str, Any]:
        """Copy the files into a run's folder; return the entry of its manifest, empty: no file.

        Raises:
          OSError: a file cannot be read or written.
          ModelError: a model's file cannot be read.
        """

    def changed(self, directory: Path, inputs: Any) -> Iterable[str]:
        """Return a line for each copy in a run's folder that is missing or has another content.

        ``inputs`` is the manifest's entry, of any form.
        """


INPUT_COPIES = Registry[InputCopies]("input_copies")
