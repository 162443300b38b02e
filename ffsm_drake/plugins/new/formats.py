"""Models of further formats for the core and the audit of logs."""

from pathlib import Path

from ffsm_drake.plugins.new.apart import check_by_trial
from ffsm_drake.spacecraft.extensions import ModelFormats


class Formats(ModelFormats):
    """MJCF, SDFormat and xacro; each is read in a process of its own."""

    check = staticmethod(check_by_trial)

    def as_urdf(self, path: Path) -> str:
        """See ModelFormats."""
        from ffsm_drake.plugins.new.urdf.formats import as_urdf  # a run needs only the check

        return as_urdf(path)


FORMATS = Formats()
