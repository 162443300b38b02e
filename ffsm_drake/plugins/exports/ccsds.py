"""Attitude and orbit of the servicer's base as CCSDS messages: AEM (504.0-B) and OEM (502.0-B).

A run has no date: t = 0 is EPOCH. The world frame's axes, which do not turn, are called EME2000.
"""

import datetime
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from ffsm_drake.common.errors import FfsmError
from ffsm_drake.runs.record import RunRecord
from ffsm_drake.spacecraft.orbit import EARTH_RADIUS, Orbit

EPOCH = datetime.datetime(2000, 1, 1, 12)


def write_aem(record: RunRecord, path: Path) -> None:
    """Attitude: quaternions (x, y, z, w) from EME2000 to the base, at each control sample."""
    meta = {
        "REF_FRAME_A": "EME2000",
        "REF_FRAME_B": "SC_BODY_1",
        "ATTITUDE_DIR": "A2B",
        "ATTITUDE_TYPE": "QUATERNION",
        "QUATERNION_TYPE": "LAST",
    }
    turns = record.positions().base_quaternion.values[:, [1, 2, 3, 0]]
    _write(record, path, "AEM", "1.0", meta, turns, ("DATA_START", "DATA_STOP"))


def write_oem(record: RunRecord, path: Path) -> None:
    """Orbit: position (km) and velocity (km/s) of the base's origin, at each control sample.

    Raises: FfsmError, if the scenario has no orbit of the Earth by its altitude.
    """
    settings, data = record.scenario.environment, record.dataset
    if settings is None or settings.altitude is None:
        raise FfsmError("OEM needs an orbit: run the scenario with environment.altitude (m)")
    orbit = Orbit.of(settings)
    axes = np.array([orbit.axes(float(time)) for time in data.time.values])  # rows r, t, h
    radius = EARTH_RADIUS + settings.altitude
    place = radius * axes[:, 0] + record.positions().base_position.values
    moving = radius * orbit.rate * axes[:, 1] + data.velocity.values[:, 3:6]
    meta = {"CENTER_NAME": "EARTH", "REF_FRAME": "EME2000"}
    _write(record, path, "OEM", "2.0", meta, np.hstack([place, moving]) / 1e3)


def _write(
    record: RunRecord,
    path: Path,
    kind: str,
    version: str,
    meta: dict[str, str],
    rows: np.ndarray,
    around: Iterable[str] = (),
) -> None:
    stamps = [_stamp(float(time)) for time in record.dataset.time.values]
    now = datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%dT%H:%M:%S")
    head = {f"CCSDS_{kind}_VERS": version, "CREATION_DATE": now, "ORIGINATOR": "FFSM_DRAKE"}
    about = {"OBJECT_NAME": "SERVICER", "OBJECT_ID": "SERVICER", **meta, "TIME_SYSTEM": "UTC"}
    about |= {"START_TIME": stamps[0], "STOP_TIME": stamps[-1]}
    data = [
        " ".join([stamp, *(f"{number:.16g}" for number in row)])
        for stamp, row in zip(stamps, rows.tolist(), strict=True)
        if np.isfinite(row).all()  # a diverged run
    ]
    begin, end = [[each] for each in around] or ([], [])
    lines = [
        *(f"{key} = {value}" for key, value in head.items()),
        "",
        "META_START",
        "COMMENT The run has no date: t = 0 is written as 2000-01-01T12:00:00.",
        "COMMENT The axes of the world frame of the run are written as EME2000.",
        *(f"{key} = {value}" for key, value in about.items()),
        "META_STOP",
        "",
        *begin,
        *data,
        *end,
    ]
    path.write_text("\n".join(lines) + "\n", encoding="ascii")


def _stamp(time: float) -> str:
    """A time of the run, s, as a date."""
    when = EPOCH + datetime.timedelta(microseconds=round(time * 1e6))
    return when.isoformat(timespec="microseconds")
