"""The specification of a campaign: scenario, controllers, dispersed values, settling criterion."""

import copy
import dataclasses
import functools
import hashlib
import itertools
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ffsm_drake.common.errors import CampaignError, FfsmError, ScenarioError, one_line
from ffsm_drake.common.files import check_regular
from ffsm_drake.plugins.campaign.dispersion import (
    SAMPLINGS,
    Distribution,
    Rule,
    check_keys,
    check_plain,
    get_value,
    number,
    parse_distribution,
    parse_rule,
)
from ffsm_drake.runs.engine import DRAKE, find_engine
from ffsm_drake.scenario import (
    Scenario,
    anchor_paths,
    anchored_policy,
    load_scenario,
    relate_paths,
    related_policy,
    scenario_from_dict,
    scenario_to_dict,
    shipped_scenarios,
    shown,
)
from ffsm_drake.scenario.layers import MAX_FILE_SIZE
from ffsm_drake.scenario.strict_yaml import StrictYamlError, read_yaml
from ffsm_drake.show.style import label_of
from ffsm_drake.spacecraft.coordinates import GROUPS
from ffsm_drake.systems.registry import find_factory, module_folder

if TYPE_CHECKING:
    from ffsm_drake.runs.tracking import Tracked

_KEYS = (
    "description",
    "scenario",
    "overrides",
    "controllers",
    "cases",
    "seed",
    "sampling",
    "parameters",
    "factors",
    "derive",
    "labels",
    "settled",
    "time_limit",
    "predictions",
    "engine",
)
# cases, values of a case, points drawn in all
_MOST_CASES, _MOST_VALUES, _MOST_NUMBERS = 1_000_000, 1000, 20_000_000
_LARGEST_SEED = 2**53  # beyond, a number read as floating point is another
_LABEL = 60  # characters
_TIME_LIMIT = 600.0  # s
COMPILED = "compiled"
OLD_ENGINE = "dynamics"  # the name of the key ``engine`` until version 0.3
_NEW = f"is now 'engine'; write engine: {COMPILED}, or engine: {DRAKE}"
# Keys that the campaign itself sets.
_RESERVED = {
    "random_seed": "follows from 'seed' and the case's number",
    "controller": "belongs into 'controllers'",
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settled:
    """Settling: each tracked error stays within its group's tolerance over the last ``hold`` s."""

    hold: float  # s; 0: the last sample alone
    tolerance: Mapping[str, float]  # rad or m, by group
    rest: float | None = None  # rad/s and m/s; no coordinate moves faster either; None: it may

    def time(self, time: np.ndarray, tracked: "Tracked", *, velocity: np.ndarray) -> float | None:
        """First time (s) from which error and velocity stay within these bounds; None: not
        settled.

        Args:
          time: control samples (n,), s.
          tracked: the tracked errors (n, k).
          velocity: velocity of the driven coordinates (n, na), rad/s or m/s.
        """
        bound = np.array([self.tolerance[group] for group in tracked.groups])
        within = (np.abs(tracked.error) <= bound).all(axis=1)  # NaN is not
        if self.rest is not None:
            within &= (np.abs(velocity) <= self.rest).all(axis=1)
        outside = np.flatnonzero(~within)
        first = 0 if outside.size == 0 else int(outside[-1]) + 1
        if first == time.size:
            return None
        since = float(time[first])
        # Half a nanosecond: samples are multiples of the period only to rounding.
        return since if since <= max(float(time[-1]) - self.hold, 0.0) + 5e-10 else None


@dataclasses.dataclass(frozen=True, kw_only=True)
class Spec:
    """A campaign's specification; the cases and their results depend on nothing else."""

    # as written, with the resolved scenario under ``base``; ``spec_from_data`` reads it back
    data: Mapping[str, Any]
    controllers: tuple[str, ...]
    cases: int
    seed: int
    sampling: str
    parameters: Mapping[str, Distribution]  # by dotted scenario key
    factors: Mapping[str, Distribution]  # by free name, for ``derive``
    derive: Mapping[str, Rule]  # by dotted scenario key, in the order of evaluation
    settled: Settled
    time_limit: float  # s of wall time; a run that takes longer becomes an error row
    predictions: bool = True  # whether stability is predicted beside each run
    engine: str = DRAKE  # see ``find_engine``; Drake computes what another one does not cover

    @property
    def base(self) -> dict[str, Any]:
        """The scenario without any case's values, as plain data; not to be changed."""
        base: dict[str, Any] = self.data["base"]
        return base

    @functools.cached_property
    def scenario(self) -> Scenario:
        """The scenario without any case's values."""
        return scenario_from_dict(self.base)

    @property
    def description(self) -> str:
        return str(self.data.get("description", ""))

    def label(self, controller: str) -> str:
        """Return the name of a controller in tables and figures."""
        labels: Mapping[str, str] = self.data.get("labels", {})
        return labels.get(controller) or label_of(controller)

    @property
    def distributions(self) -> dict[str, Distribution]:
        """Parameters and factors in their order."""
        return {**self.parameters, **self.factors}

    @property
    def names(self) -> tuple[str, ...]:
        """The names of a case's values: parameters, factors, derived values."""
        return (*self.parameters, *self.factors, *self.derive)

    @property
    def strides(self) -> dict[str, int]:
        """Number of successive cases with the same value of a list: 1; in a grid, the number of
        combinations of the lists after it.
        """
        strides, names = {}, tuple(self.distributions)
        for i, name in enumerate(names):
            after = names[i + 1 :] if self.sampling == "grid" else ()
            strides[name] = math.prod(len(self.distributions[each].levels) for each in after)
        return strides

    def level(self, name: str, case: int) -> str:
        """Return the name of the value that a list has in a case."""
        names = tuple(self.distributions[name].levels)
        return names[case // self.strides[name] % len(names)]

    @property
    def runs(self) -> int:
        return self.cases * len(self.controllers)

    def to_json(self, folder: Path | None = None) -> str:
        """Return the specification as text; for a file in ``folder``, with paths relative to
        that.
        """
        data = copy.deepcopy(dict(self.data))
        if folder is not None:
            relate_paths(data["base"], folder)
            if "controllers" in data:
                data["controllers"] = [
                    related_policy(name, folder) for name in _controllers(data["controllers"])
                ]
        return json.dumps(data, sort_keys=False)

    @property
    def fingerprint(self) -> str:
        """SHA-256 of all that shapes a result."""
        shaping = {
            key: value for key, value in self.data.items() if key not in ("description", "labels")
        }
        return hashlib.sha256(json.dumps(shaping, sort_keys=True).encode()).hexdigest()


def why_not_compiled() -> str:
    """Return why COMPILED, the default engine, cannot be used here; empty: it can."""
    try:
        find_engine(COMPILED)
    except FfsmError as error:
        return one_line(error)
    return ""


def check_engine(spec: Spec) -> None:
    """Raise FfsmError unless the engine of a campaign can be used here."""
    if spec.data.get(OLD_ENGINE, DRAKE) != DRAKE:
        raise CampaignError(f"{OLD_ENGINE}: {_NEW}, into a new database")
    find_engine(spec.engine)


def shipped_campaigns() -> dict[str, Path]:
    """Return the campaigns that ship with the package: name -> file."""
    return {path.stem: path for path in sorted((Path(__file__).parent / "shipped").glob("*.yaml"))}


def load_spec(name_or_path: str | Path) -> Spec:
    """Read a specification by shipped name or path, and check it.

    Raises:
      CampaignError, ScenarioError: the file, a key or a value cannot be used; one line with place
        and reason.
    """
    shipped = shipped_campaigns()
    path = shipped.get(str(name_or_path), Path(name_or_path))
    if not path.is_file():
        raise CampaignError(
            f"{path}: no such campaign; choose one of {', '.join(shipped)}, or give a YAML file"
        )
    try:
        check_regular(path, limit=MAX_FILE_SIZE)
        data = read_yaml(path.read_text(encoding="utf-8"))
    except StrictYamlError as error:
        raise CampaignError(f"{path}: is not valid YAML: {one_line(error)}") from error
    except (OSError, UnicodeDecodeError) as error:
        raise CampaignError(f"{path}: cannot be read: {one_line(error)}") from error
    if not isinstance(data, Mapping):
        raise CampaignError(f"{path}: must be a mapping with keys {', '.join(_KEYS)}")
    try:
        check_plain(data, place="specification")
        if OLD_ENGINE in data:
            raise CampaignError(f"{OLD_ENGINE}: {_NEW}")
        check_keys(data, _KEYS, place="specification")
        engine = DRAKE if why_not_compiled() else COMPILED
        whole = {"engine": engine, **data, "base": _base(data, folder=path.parent)}
        _anchor_policies(whole, path.parent)
        spec = spec_from_data(whole)
        return _with_python_path(spec)
    except ScenarioError as error:
        raise CampaignError(f"{path}: {error}") from error
    except CampaignError as error:
        raise CampaignError(f"{path}: {one_line(error).removeprefix('specification.')}") from error


def _with_python_path(spec: Spec) -> Spec:
    """Add the folders of all user-supplied modules, so that any folder can resume the campaign."""
    base = spec.base
    blocks = [(name, base["blocks"][name]) for name in ("reference", "actuation")]
    blocks += [
        (kind, block) for kind in ("sensing", "forces") for block in base["blocks"][kind].values()
    ]
    named = [("controller", name) for name in spec.controllers]
    named += [(kind, block["system"]) for kind, block in blocks if block is not None]
    for kind, system in named:
        find_factory(kind, system, python_path=base["python_path"])
    folders = [str(folder) for _, system in named if (folder := module_folder(system)) is not None]
    path = list(dict.fromkeys([*base["python_path"], *folders]))
    return spec_from_data({**spec.data, "base": {**base, "python_path": path}})


def spec_from_json(text: str, folder: Path | None = None) -> Spec:
    """Return the inverse of ``Spec.to_json`` for the same folder. Raises CampaignError for other
    text.
    """
    try:
        data = json.loads(text)
    except ValueError as error:
        raise CampaignError(f"not a campaign's specification: {one_line(error)}") from error
    if folder is not None:
        anchor_paths(data["base"], folder)
        _anchor_policies(data, folder)
    return spec_from_data(data)


def _anchor_policies(data: dict[str, Any], folder: Path) -> None:
    """Make the files of a specification's policies absolute, where they are in a folder."""
    if "controllers" in data:
        names = _controllers(data["controllers"])
        data["controllers"] = [anchored_policy(name, folder) for name in names]


def spec_from_data(data: Mapping[str, Any]) -> Spec:
    """Return the specification of plain data whose ``base`` holds the resolved scenario."""
    seed = _whole(data.get("seed", 0), place="seed", least=0, most=_LARGEST_SEED)
    time_limit = number(data.get("time_limit", _TIME_LIMIT), place="time_limit")
    if not 0.0 < time_limit <= 1e6:
        raise CampaignError(f"time_limit: must be > 0 s and at most 1e6 s, not {time_limit:g}")
    predictions = data.get("predictions", True)
    if not isinstance(predictions, bool):
        raise CampaignError(f"predictions: must be true or false, not {predictions!r}")
    engine = data.get("engine", data.get(OLD_ENGINE, DRAKE))
    if not isinstance(engine, str):
        raise CampaignError(f"engine: must be a name, such as {DRAKE}, not {shown(engine)}")
    sampling = data.get("sampling", SAMPLINGS[0])
    if sampling not in SAMPLINGS:
        raise CampaignError(
            f"sampling: '{sampling}' is unknown; choose one of {', '.join(SAMPLINGS)}"
        )
    parameters, factors = (
        {
            str(name): parse_distribution(entry, place=f"{section}.{name}")
            for name, entry in _section(data, section).items()
        }
        for section in ("parameters", "factors")
    )
    if not parameters and not factors:
        raise CampaignError("parameters: must disperse at least one scenario value")
    derive = {
        str(name): parse_rule(entry, place=f"derive.{name}")
        for name, entry in _section(data, "derive").items()
    }
    if sampling == "grid":
        data = {"cases": _grid_size({**parameters, **factors}), **data}
    if "cases" not in data:
        raise CampaignError("cases: is missing; give the number of cases")
    cases = _whole(data["cases"], place="cases", least=1, most=_MOST_CASES)
    spec = Spec(
        data=data,
        controllers=_controllers(data.get("controllers", [data["base"]["controller"]])),
        cases=cases,
        seed=seed,
        sampling=sampling,
        parameters=parameters,
        factors=factors,
        derive=derive,
        settled=parse_settled(
            data.get("settled", {}), Scenario(tolerance=data["base"]["tolerance"])
        ),
        time_limit=time_limit,
        predictions=predictions,
        engine=engine,
    )
    _check_names(spec)
    labels = data.get("labels", {})
    if not isinstance(labels, Mapping) or not all(
        name in spec.controllers and isinstance(label, str) and 0 < len(label) <= _LABEL
        for name, label in labels.items()
    ):
        raise CampaignError(
            f"labels: must give controllers of this campaign a text of at most {_LABEL} characters"
        )
    if len(shown_as := {spec.label(name) for name in spec.controllers}) < len(spec.controllers):
        raise CampaignError(
            f"labels: controllers share a name in tables: {', '.join(sorted(shown_as))}; give each "
            "its own, as labels: {'module:Class': name}"
        )
    return spec


def parse_settled(data: Any, scenario: Scenario) -> Settled:
    """Return the criterion under ``settled``; groups that it leaves out have the scenario's
    tolerance.

    Raises CampaignError for an unknown key or a value out of range.
    """
    if not isinstance(data, Mapping):
        raise CampaignError("settled: must be a mapping with hold, tolerance and rest")
    check_keys(data, ("hold", "tolerance", "rest"), place="settled")
    hold = number(data.get("hold", 2.0), place="settled.hold")
    if hold < 0.0:
        raise CampaignError(f"settled.hold: must be >= 0 s, not {hold:g}")
    given = data.get("tolerance", {})
    if not isinstance(given, Mapping):
        raise CampaignError(f"settled.tolerance: must be a mapping by group: {', '.join(GROUPS)}")
    check_keys(given, GROUPS, place="settled.tolerance")
    tolerance = {
        group: _positive(
            given.get(group, scenario.tolerance_of(group)), place=f"settled.tolerance.{group}"
        )
        for group in GROUPS
    }
    rest = data.get("rest")
    if rest is not None:
        rest = _positive(rest, place="settled.rest")
    return Settled(hold=hold, tolerance=tolerance, rest=rest)


def _positive(data: Any, *, place: str) -> float:
    value = number(data, place=place)
    if value <= 0.0:
        raise CampaignError(f"{place}: must be > 0, not {value:g}")
    return value


def _base(data: Mapping[str, Any], *, folder: Path) -> dict[str, Any]:
    """Return the resolved scenario as plain data, fixed overrides included."""
    name = data.get("scenario", "postcapture")
    if not isinstance(name, str):
        raise CampaignError(f"scenario: must be a shipped name or a file, not {shown(name)}")
    overrides = _section(data, "overrides")
    for key in overrides:
        _check_not_reserved(key, place="overrides")
    place = name if name in shipped_scenarios() else folder / name
    texts = [f"{key}={json.dumps(value)}" for key, value in overrides.items()]  # JSON is YAML
    return scenario_to_dict(load_scenario(place, texts))


def _section(data: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    section = data.get(name)
    if section is None:
        return {}
    if not isinstance(section, Mapping):
        raise CampaignError(f"{name}: must be a mapping, not {shown(section)}")
    return section


def _whole(data: Any, *, place: str, least: int, most: int) -> int:
    value = number(data, place=place)
    if not value.is_integer() or value < least:
        raise CampaignError(f"{place}: must be a whole number of at least {least}, not {data}")
    if value > most:
        raise CampaignError(f"{place}: must be at most {most}, not {data}")
    return int(value)


def _grid_size(distributions: Mapping[str, Distribution]) -> int:
    """Return the number of combinations of the values of lists."""
    for name, distribution in distributions.items():
        if not distribution.levels:
            raise CampaignError(f"{name}: must be a list, because sampling is grid")
    return math.prod(len(distribution.levels) for distribution in distributions.values())


def _controllers(data: Any) -> tuple[str, ...]:
    names = data if isinstance(data, list) else [data]
    for name in names:
        if not isinstance(name, str):
            raise CampaignError(
                f"controllers: must be names, or module:attribute, not {shown(name)}"
            )
    if not names or len(set(names)) < len(names):
        raise CampaignError("controllers: must name at least one, each once")
    return tuple(names)


def _check_names(spec: Spec) -> None:
    """Raise CampaignError unless each value is set once, and known before a rule reads it."""
    if len(spec.names) > _MOST_VALUES:
        raise CampaignError(
            f"parameters: at most {_MOST_VALUES} values with factors and derived ones, not "
            f"{len(spec.names)}"
        )
    if spec.cases * len(spec.distributions) > _MOST_NUMBERS:
        raise CampaignError(
            f"cases: {spec.cases} cases with {len(spec.distributions)} values are more than "
            f"{_MOST_NUMBERS} numbers"
        )
    keys = (*spec.parameters, *spec.derive)
    if repeated := [name for name in keys if keys.count(name) > 1] or sorted(
        {*keys} & {*spec.factors}
    ):
        raise CampaignError(f"derive.{repeated[0]}: is dispersed already; a value can be set once")
    for section, names in (("parameters", spec.parameters), ("derive", spec.derive)):
        for name in names:
            _check_not_reserved(name, place=section)
    for inner, outer in itertools.permutations(keys, 2):
        if inner.startswith(f"{outer}."):
            raise CampaignError(
                f"parameters.{inner}: lies within {outer}, which is set too; set one of them"
            )
    for factor in spec.factors:
        if "." in factor or factor in spec.base:
            raise CampaignError(
                f"factors.{factor}: must be a free name, not a scenario key; see 'parameters'"
            )
        if not any(factor in rule.sources for rule in spec.derive.values()):
            raise CampaignError(f"factors.{factor}: no rule of 'derive' uses it")
    known = {*spec.parameters, *spec.factors}
    for name, rule in spec.derive.items():
        for source in rule.sources:
            if source in known:
                continue
            if source in spec.derive:
                raise CampaignError(
                    f"derive.{name}: reads {source}, which must be derived before it"
                )
            try:
                get_value(spec.base, source)
            except CampaignError:
                raise CampaignError(
                    f"derive.{name}: '{source}' is neither a factor nor a scenario value"
                ) from None
        known.add(name)


def _check_not_reserved(key: str, *, place: str) -> None:
    if key in _RESERVED:
        raise CampaignError(f"{place}.{key}: {_RESERVED[key]}")
