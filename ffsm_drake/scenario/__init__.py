"""The scenario: everything that defines a run, as plain data with units."""

from ffsm_drake.scenario.schema import *  # noqa: F403
from ffsm_drake.scenario.schema import ENTRY_POINT_GROUP, PerCoordinate, inertia_matrix, schema_fields  # noqa: F401
