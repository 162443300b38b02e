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
from ffsm_drake.common.settings import setting, settings_of, unknown
from ffsm_drake.plugins.campaign.dispersion import (
    SAMPLINGS,
    Distribution,
    Rule,
    get_value,
    parse_distribution,
    parse_rule,
)
from ffsm_drake.runs.engine import DRAKE, find_engine
from ffsm_drake.scenario import (
    Scenario,
    anchor_paths,
    anchored_policy,
    kind_of,
    load_scenario,
    relate_paths,
    related_policy,
    scenario_from_dict,
    scenario_to_dict,
    shipped_scenarios,
)
from ffsm_drake.scenario.layers import parsed, read_text
from ffsm_drake.scenario.resolving import build_settings, resolve
from ffsm_drake.show.style import label_of
from ffsm_drake.spacecraft.coordinates import GROUPS
from ffsm_drake.systems.registry import find_factory, module_folder

if TYPE_CHECKING:
    from ffsm_drake.runs.tracking import Tracked

# cases, values of a case, points drawn in all
_MOST_CASES, _MOST_VALUES, _MOST_NUMBERS = 1_000_000, 1000, 20_000_000
_LABEL = 60  # characters
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

    hold: float = setting(2.0, "s", "duration at the end; 0: the last sample alone", least=0)
    tolerance: dict[str, float] = setting({}, "rad or m", "largest error, by group", above=0)
    rest: float | None = setting(
        None, "rad/s or m/s", "largest rate of any coordinate; null: no limit", above=0
    )

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

    def completed(self, scenario: Scenario) -> "Settled":
        """Return it with the scenario's tolerance of each group that it leaves out.

        Raises ScenarioError for a name that is no group.
        """
        for group in self.tolerance:
            if group not in GROUPS:
                raise ScenarioError(f"settled.tolerance.{group}", unknown(group, GROUPS))
        tolerance = {
            group: self.tolerance.get(group, scenario.tolerance_of(group)) for group in GROUPS
        }
        return dataclasses.replace(self, tolerance=tolerance)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Spec:
    """A campaign's specification; the cases and their results depend on nothing else."""

    description: str = setting("")
    scenario: str = setting("postcapture", "", "scenario's shipped name or file")
    overrides: dict[str, Any] = setting({})
    # the resolved scenario without any case's values, as plain data; not to be changed
    base: dict[str, Any] = setting({})
    controllers: list[str] = setting([])
    cases: int = setting(1, least=1, most=_MOST_CASES)
    # beyond, a number read as floating point is another
    seed: int = setting(0, least=0, most=2**53)
    sampling: str = setting(SAMPLINGS[0], one_of=SAMPLINGS)
    parameters: dict[str, Any] = setting({}, "", "distributions by dotted scenario key")
    factors: dict[str, Any] = setting({}, "", "distributions by free name, for ``derive``")
    derive: dict[str, Any] = setting({}, "", "rules by dotted key, in the order of evaluation")
    labels: dict[str, str] = setting({}, "", "names of controllers in tables")
    settled: Settled = setting(Settled())
    time_limit: float = setting(
        600.0, "s", "wall time of a run; beyond, it is an error row", above=0, most=1e6
    )
    predictions: bool = setting(True, "", "whether stability is predicted beside each run")
    engine: str = setting(DRAKE, "", "see ``find_engine``; Drake computes what it does not cover")
    data: Mapping[str, Any] = dataclasses.field(default_factory=dict)  # as ``spec_from_data`` read

    @functools.cached_property
    def base_scenario(self) -> Scenario:
        """The scenario without any case's values."""
        return scenario_from_dict(self.base)

    def label(self, controller: str) -> str:
        """Return the name of a controller in tables and figures."""
        return self.labels.get(controller) or label_of(controller)

    @functools.cached_property
    def distributions(self) -> dict[str, Distribution]:
        """Parameters and factors in their order."""
        return {
            name: parse_distribution(entry, place=f"{section}.{name}")
            for section in ("parameters", "factors")
            for name, entry in getattr(self, section).items()
        }

    @functools.cached_property
    def rules(self) -> dict[str, Rule]:
        """The rules of ``derive``."""
        return {
            name: parse_rule(entry, place=f"derive.{name}") for name, entry in self.derive.items()
        }

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
                    related_policy(name, folder) for name in _listed(data["controllers"])
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
        data = parsed(read_text(path), str(path))
    except ScenarioError as error:
        raise CampaignError(str(error)) from error
    if not isinstance(data, Mapping):
        names = ", ".join(name for name in settings_of(Spec) if name != "base")
        raise CampaignError(f"{path}: must be a mapping with keys {names}")
    try:
        if OLD_ENGINE in data:
            raise CampaignError(f"{OLD_ENGINE}: {_NEW}")
        engine = DRAKE if why_not_compiled() else COMPILED
        whole = {"engine": engine, **data, "base": _base(data, folder=path.parent)}
        return _with_python_path(spec_from_data(_anchored(whole, path.parent)))
    except (CampaignError, ScenarioError) as error:
        raise CampaignError(f"{path}: {one_line(error)}") from error


def _with_python_path(spec: Spec) -> Spec:
    """Add the folders of all user-supplied modules, so that any folder can resume the campaign."""
    given = spec.base["python_path"]
    blocks = spec.base_scenario.blocks.choices()
    named = [("controller", name) for name in spec.controllers]
    named += [(kind_of(name), block.system) for name, block in blocks.items()]
    for kind, system in named:
        find_factory(kind, system, python_path=given)
    folders = [str(folder) for _, system in named if (folder := module_folder(system)) is not None]
    path = list(dict.fromkeys([*given, *folders]))
    return spec_from_data({**spec.data, "base": {**spec.base, "python_path": path}})


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
        data = _anchored(data, folder)
    return spec_from_data(data)


def _anchored(data: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Return a specification with absolute files of its policies, where they are in a folder."""
    if "controllers" not in data:
        return dict(data)
    names = resolve(list[str], None, _listed(data["controllers"]), "controllers")
    return {**data, "controllers": [anchored_policy(name, folder) for name in names]}


def spec_from_data(data: Mapping[str, Any]) -> Spec:
    """Return the specification of plain data whose ``base`` holds the resolved scenario.

    Raises:
      CampaignError, ScenarioError: a key or a value cannot be used.
    """
    given = {name: value for name, value in data.items() if value is not None}
    given.setdefault("engine", given.pop(OLD_ENGINE, DRAKE))
    given["controllers"] = _listed(given.get("controllers", data["base"]["controller"]))
    spec: Spec = build_settings(Spec, given, "")
    if not spec.distributions:
        raise CampaignError("parameters: must disperse at least one scenario value")
    if spec.sampling == "grid":
        for name, distribution in spec.distributions.items():
            if not distribution.levels:
                raise CampaignError(f"{name}: must be a list, because sampling is grid")
        data = {
            "cases": math.prod(len(each.levels) for each in spec.distributions.values()),
            **data,
        }
    if "cases" not in data:
        raise CampaignError("cases: is missing; give the number of cases")
    settled = spec.settled.completed(Scenario(tolerance=spec.base["tolerance"]))
    spec = dataclasses.replace(spec, data=data, cases=int(data["cases"]), settled=settled)
    _check_size(spec)
    _check_names(spec)
    _check_controllers(spec)
    return spec


def _listed(value: Any) -> Any:
    """Return a list unchanged, and anything else in a list."""
    return value if isinstance(value, list) else [value]


def _check_controllers(spec: Spec) -> None:
    if not spec.controllers or len(set(spec.controllers)) < len(spec.controllers):
        raise CampaignError("controllers: must name at least one, each once")
    if not all(
        name in spec.controllers and 0 < len(label) <= _LABEL for name, label in spec.labels.items()
    ):
        raise CampaignError(
            f"labels: must give controllers of this campaign a text of at most {_LABEL} characters"
        )
    if len(shown_as := {spec.label(name) for name in spec.controllers}) < len(spec.controllers):
        raise CampaignError(
            f"labels: controllers share a name in tables: {', '.join(sorted(shown_as))}; give each "
            "its own, as labels: {'module:Class': name}"
        )


def _base(data: Mapping[str, Any], *, folder: Path) -> dict[str, Any]:
    """Return the resolved scenario as plain data, fixed overrides included."""
    name = resolve(str, None, data.get("scenario") or "postcapture", "scenario")
    overrides = resolve(dict[str, Any], None, data.get("overrides") or {}, "overrides")
    for key in overrides:
        _check_not_reserved(key, place="overrides")
    place = name if name in shipped_scenarios() else folder / name
    texts = [f"{key}={json.dumps(value)}" for key, value in overrides.items()]  # JSON is YAML
    return scenario_to_dict(load_scenario(place, texts))


def _check_size(spec: Spec) -> None:
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


def _check_names(spec: Spec) -> None:
    """Raise CampaignError unless each value is set once, and known before a rule reads it."""
    for name in spec.names:
        if not name.isprintable() or not name:
            raise CampaignError(f"parameters: the name {name!r} must be printable text")
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
        if not any(factor in rule.sources for rule in spec.rules.values()):
            raise CampaignError(f"factors.{factor}: no rule of 'derive' uses it")
    known = {*spec.parameters, *spec.factors}
    for name, rule in spec.rules.items():
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
