"""Audit of another simulator's log of a free-flying spacecraft against a URDF.

It checks the frames and units of the velocities, then momentum and the joints' efforts with the
plant of this package. Every check is a fit. Displacements must be the integrals of the logged
rates, and momenta the integrals of the logged forces. If the residual exceeds the tolerance and
the error bound from sampling and digits, the audit names the mistake that explains the residual.
"""

import tempfile
import warnings
from pathlib import Path

import numpy as np
from pydrake.multibody.plant import MultibodyPlant

from ffsm_drake.common.errors import ModelError, RecordError
from ffsm_drake.common.files import write_text
from ffsm_drake.common.numbers import counted
from ffsm_drake.plugins.audit.checks import Audit, Check, fault, undecided
from ffsm_drake.plugins.audit.dynamics import Dynamics
from ffsm_drake.plugins.audit.efforts import check_efforts
from ffsm_drake.plugins.audit.log import RATES, Log, only, with_rates
from ffsm_drake.plugins.audit.misfit import STILL, means, noise
from ffsm_drake.plugins.audit.momentum import check_momentum
from ffsm_drake.plugins.audit.motions import turned
from ffsm_drake.plugins.audit.rates import check_rates
from ffsm_drake.plugins.audit.reading import MEANT, read_log
from ffsm_drake.scenario import Model
from ffsm_drake.spacecraft.extensions import MODEL_FORMATS
from ffsm_drake.spacecraft.plant import base_body, make_plant

TOLERANCE = 1e-3  # largest residual, as a share of the motion or of the exchanged momentum
_DIRECT = (".urdf", ".xacro", ".yaml", ".yml")  # other kinds of files are converted
_EVEN = 0.8  # least share of equal periods in an evenly sampled log
_FARTHEST = 2.8  # rad between samples, nearly half a turn
_TIME_UNITS = {"milliseconds": 1e-3, "microseconds": 1e-6, "nanoseconds": 1e-9}


def audit(
    log: Path,
    urdf: Path,
    *,
    columns: dict[str, str] | None = None,
    tolerance: float = TOLERANCE,
) -> Audit:
    """Check a log (``read_log``) against a model with one free base.

    Args:
      urdf: the file of the model: URDF, MJCF, SDFormat or model directives.
      columns: other names of columns; see ``read_log``.
      tolerance: largest residual, relative to a displacement, to the momentum that the bodies
        exchange, and to the momentum of a joint.

    Raises:
      ModelError, RecordError: a file cannot be used.
    """
    plant = _plant(urdf)
    dynamics = Dynamics(plant)
    read = read_log(log, dynamics.names, base=base_body(plant).name(), columns=columns)
    try:
        with np.errstate(all="ignore"), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return Audit(checks=tuple(_checks(read, dynamics, tolerance)))
    except (np.linalg.LinAlgError, ValueError, FloatingPointError) as error:
        said = "its numbers are too large or too small to be computed with"
        raise RecordError(f"{log}: {said}: {error}") from error


def _plant(file: Path) -> MultibodyPlant:
    with tempfile.TemporaryDirectory() as folder:
        given = file
        if file.suffix.lower() not in _DIRECT:
            given = Path(folder, f"{file.stem}.urdf")
            try:
                write_text(given, MODEL_FORMATS.only("--urdf").as_urdf(file))
            except ModelError as error:
                raise ModelError(f"{file}: {error}") from None
        try:
            model = Model(directives=str(given), end_effector="WorldModelInstance::world")
            return make_plant(model, jointless=True)
        except ModelError as error:
            told = str(error).replace(str(given), str(file))
            raise ModelError(told.removeprefix("model.directives: ")) from None


def _checks(log: Log, dynamics: Dynamics, tolerance: float) -> list[Check]:
    checks: list[Check] = []
    log = log.replace(angles=np.unwrap(log.angles, axis=0))  # some logs wrap angles at a turn
    for step in (_time, _quaternion, _time_unit, _turn):
        found, log = step(log)
        checks += found
        if found and found[-1].verdict == "cannot tell":
            return checks
    missing = [MEANT[what] for what in RATES if what in log.missing]
    if missing:
        said = f"{', '.join(missing)}: not logged, differentiated"
        checks.append(Check(name="rates", statement=said, verdict="measured"))
        log = with_rates(log)
    found, log = check_rates(log, dynamics, tolerance)
    checks += found
    momentum, balance = check_momentum(log, dynamics, tolerance)
    checks.append(momentum)
    lost = {"dropped_samples", "repeated_samples"} & {check.cause for check in checks}
    if momentum.verdict != "does not hold" and dynamics.names and not lost:
        checks += check_efforts(log, balance, tolerance)
    return checks


def _time(log: Log) -> tuple[list[Check], Log]:
    """Check the order and gaps of the samples. The returned log has only samples in order."""
    steps, digit = np.diff(log.time), log.digits.get("time", 0.0)
    if (back := np.flatnonzero(steps <= 0.0)).size:
        kept = log.time > np.maximum.accumulate(np.concatenate([[-np.inf], log.time[:-1]]))
        said = (
            f"{counted(int(np.sum(~kept)), 'sample')} not later than all before, first after "
            f"{log.time[back[0]]:g} s"
        )
        if steps.min() > -digit:
            said = f"{said}, but the last digit of the time is {digit:.2g} s: log more digits"
            return [undecided("time", "digits", said)], log
        return [fault("time", "time_order", said)], only(log, kept)
    period, size = float(np.median(steps)), log.time.size
    alike = 0.02 * period + digit
    times = np.round(steps / period)
    gaps = np.flatnonzero((times > 1) & (np.abs(steps - times * period) <= alike * times))
    if np.mean(np.abs(steps - period) <= alike) < _EVEN:
        said = f"{size} samples at steps of {steps.min():.4g} to {steps.max():.4g} s{log.note}"
    elif gaps.size:
        missing = counted(int(times[gaps].sum()) - gaps.size, "sample")
        said = (
            f"about {missing} missing, in {counted(gaps.size, 'gap')}, the first after "
            f"{log.time[gaps[0]]:g} s"
        )
        return [fault("time", "dropped_samples", said)], log
    else:
        said = f"{size} samples, period {period:.4g} s{log.note}"
    return [Check(name="time", statement=said)], log


def _quaternion(log: Log) -> tuple[list[Check], Log]:
    """Check the norm of the quaternions, which is 1 in the returned log."""
    largest = np.abs(log.quaternion).max(axis=1, keepdims=True)
    size = np.linalg.norm(log.quaternion / largest, axis=1, keepdims=True)
    whole = log.replace(quaternion=log.quaternion / largest / size)
    norm = size * largest
    worst = float(np.abs(norm - 1.0).max())
    if worst <= 1e-4 + 2.0 * log.digits.get("quaternion", 0.0) + 1.5 * noise(norm):
        return [Check(name="quaternion", statement=f"its norm is 1 within {worst:.2g}")], whole
    said = f"its norm is {norm.min():.6g} to {norm.max():.6g}, not 1"
    return [fault("quaternion", "quaternion_norm", said)], whole


def _time_unit(log: Log) -> tuple[list[Check], Log]:
    """Find the unit of time in which joints and base follow their rates; seconds by default."""
    period, ratios = np.diff(log.time), []
    for position, rate in ((log.angles, log.rates), (log.position, log.linear)):
        moved = np.linalg.norm(np.diff(position, axis=0), axis=1).sum()
        expected = (means(np.linalg.norm(rate, axis=1)) * period).sum()
        if moved > STILL and expected > 0.0:
            ratios.append(moved / expected)
    for unit, factor in _TIME_UNITS.items():
        if ratios and all(abs(ratio / factor - 1.0) < 0.2 for ratio in ratios):
            said = f"it is in {unit}, or every rate is {1.0 / factor:.0e} times too large"
            return [fault("time", "time_unit", said)], log.replace(time=log.time * factor)
    return [], log


def _turn(log: Log) -> tuple[list[Check], Log]:
    """Check that successive attitudes are less than about half a turn apart."""
    turn = float(np.linalg.norm(turned(log), axis=1).max())
    if turn > 0.5:
        speed = means(np.linalg.norm(log.angular, axis=1))
        turn = max(turn, float((speed * np.diff(log.time)).max()))
    if turn <= _FARTHEST:
        return [], log
    said = f"the base turns by {turn:.2g} rad between two samples: log more of them"
    return [undecided("attitude", "half_turns", said)], log
