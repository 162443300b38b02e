"""Laws that break their contract: none gives a wrong run, and no trace changes their runs.

Some only do what cannot be traced: these are called at each sample.
"""

import dataclasses
import functools
import itertools
import os
import sys
import time
from pathlib import Path
from typing import ClassVar

import compared_runs
import numpy as np
import pytest

from ffsm_drake import ControlLaw, gain, load_scenario, simulate_many
from ffsm_drake.plugins.compiled.parameters import parameters_of
from ffsm_drake.runs.engine import NotCovered
from ffsm_drake.spacecraft.nominal import PlantModel

DRAWS = int(os.environ.get("FFSM_DRAWS", "2"))
THIS = Path(__file__).name
LAST = {}  # what a law keeps in its module


@dataclasses.dataclass(frozen=True, kw_only=True)
class Pd(ControlLaw):
    """An honest law; those below each break the contract."""

    k_p: np.ndarray = gain(20.0)
    k_d: np.ndarray = gain(60.0)

    def step(self, sample, state):
        return self.force(sample), state

    def force(self, sample):
        return self.k_p * sample.e + self.k_d * sample.e_dot


class Counts(Pd):
    calls: ClassVar = itertools.count()

    def force(self, sample):
        return super().force(sample) + 1e-3 * next(self.calls)


class Draws(Pd):
    def force(self, sample):
        return super().force(sample) + np.random.default_rng().normal(size=sample.e.size)


class DrawsLegacy(Pd):
    def force(self, sample):
        return super().force(sample) + np.random.normal(size=sample.e.size)  # noqa: NPY002


class Branches(Pd):
    def force(self, sample):
        return super().force(sample) * (0.5 if np.abs(sample.e).max() > 0.1 else 1.0)


class Recovers(Pd):
    """Its branch is rare, and its trace takes the other one."""

    def force(self, sample):
        try:
            if float(np.abs(sample.e).max()) > 1e3:
                return 0.0 * sample.e
        except Exception:
            pass
        return super().force(sample)


class Caches(Pd):
    kept: ClassVar = {}

    def force(self, sample):
        before = self.kept.get("e", sample.e)
        self.kept["e"] = sample.e.copy()
        return super().force(sample) + 5.0 * (sample.e - before)


class KeepsFirst(Pd):
    kept: ClassVar = {}

    def force(self, sample):
        return super().force(sample) + 5.0 * (sample.e - self.kept.setdefault("e", sample.e))


class KeepsAll(Pd):
    every: ClassVar = []

    def force(self, sample):
        self.every.append(sample.e)
        return super().force(sample) + 0.1 * self.every[-min(3, len(self.every))]


class InModule(Pd):
    def force(self, sample):
        before, LAST["v"] = LAST.get("v", sample.v), sample.v
        return super().force(sample) + (sample.v - before)


class InFunction(Pd):
    def force(self, sample, kept=[]):  # noqa: B006
        kept.append(sample.e_dot)
        return super().force(sample) + kept[0]


class InItself(Pd):
    def step(self, sample, state):
        before = getattr(self, "before", sample.e)
        object.__setattr__(self, "before", sample.e)
        return super().force(sample) + 5.0 * (sample.e - before), state


class Remembers(Pd):
    """It keeps results outside of its memory, which is no fault."""

    @staticmethod
    @functools.cache
    def scaled(value):
        return 2.0 * value

    def force(self, sample):
        return np.array([self.scaled(each) for each in super().force(sample)])


class Returns(Pd):
    """Its memory is a number of another sample."""

    kept: ClassVar = {}

    def initial_state(self):
        return {"first": np.zeros(3)}

    def step(self, sample, state):
        return self.force(sample), {"first": self.kept.setdefault("e", sample.e[:3])}


class Writes(Pd):
    def force(self, sample):
        sample.v[:] = 0.0
        return super().force(sample)


class WritesGain(Pd):
    def force(self, sample):
        self.k_p[:] *= 0.999
        return super().force(sample)


class WritesMemory(Pd):
    def initial_state(self):
        return {"sum": np.zeros(3)}

    def step(self, sample, state):
        state["sum"][:] += sample.e[:3]
        return self.force(sample), state


class Clock(Pd):
    def force(self, sample):
        return super().force(sample) + time.perf_counter() % 1.0


class Solves(Pd):
    """Without exchange of rows, the elimination divides by zero."""

    def force(self, sample):
        n = sample.e.size
        swap = np.eye(n)[::-1] + 0.0 * sample.e[:, None]
        return np.linalg.solve(swap + 1e-18 * np.diag(sample.e), super().force(sample))


@dataclasses.dataclass(frozen=True, kw_only=True)
class ReadsPlant(Pd):
    """The mass that it reads differs between runs with the same code."""

    model: PlantModel

    def force(self, sample):
        return super().force(sample) * self.model.plant.CalcTotalMass(self.model.context) / 500.0


class Shape(Pd):
    def force(self, sample):
        return super().force(sample)[:-1]


class Names(Pd):
    def step(self, sample, state):
        return self.force(sample), {"more": sample.e}


HOSTILE = (
    Counts, Draws, DrawsLegacy, Branches, Recovers, Caches, KeepsFirst, KeepsAll, InModule,
    InFunction, InItself, Returns, Writes, WritesGain, WritesMemory, Clock, Solves,
    ReadsPlant, Shape, Names,
)  # fmt: skip
CALLED = (Branches, Recovers, Writes, ReadsPlant)  # they keep the contract of a law
# Their reason is a line of theirs; of the others, the runs differ.
WITH_LINE = (
    Branches, Recovers, Caches, KeepsFirst, KeepsAll, InModule, InFunction, Writes, WritesGain,
    ReadsPlant,
)  # fmt: skip
FAIL = (WritesMemory, Shape, Names)  # with Drake, too


def scenarios_of(law, count, monkeypatch):
    monkeypatch.setitem(sys.modules, "hostile_laws", sys.modules[__name__])
    monkeypatch.setattr(sys.modules[__name__], law.__name__, law, raising=False)
    return [
        load_scenario(
            "postcapture",
            [
                "duration=0.1", f"random_seed={k}", f"payload.nominal.mass={80 + 10 * k}",
                f"controller=hostile_laws:{law.__name__}",
            ],
        )
        for k in range(count)
    ]  # fmt: skip


def runs_of(law, count, monkeypatch):
    scenarios = scenarios_of(law, count, monkeypatch)
    return simulate_many(scenarios, engine="compiled", keep_errors=True)


@pytest.fixture(autouse=True)
def _nothing_kept():
    for kept in (Caches.kept, KeepsFirst.kept, Returns.kept, LAST, KeepsAll.every):
        kept.clear()
    InFunction.force.__defaults__[0].clear()


@pytest.mark.parametrize("law", [Pd, pytest.param(Remembers, marks=pytest.mark.slow)])
def test_a_law_of_a_user_joins_by_itself(law, monkeypatch):
    found = runs_of(law, 2, monkeypatch)
    assert {record.engine for record in found} == {"compiled"}


def check(law, monkeypatch):
    """No run is compiled; Drake has each, as if there had been no trace."""
    for record in runs_of(law, 2, monkeypatch):
        if isinstance(record, Exception):  # as with Drake
            assert issubclass(law, FAIL), record
            assert "object" not in str(record), record
        else:
            assert record.engine.startswith("drake ("), record.engine
            assert not issubclass(law, FAIL)
            assert law not in WITH_LINE or f" {THIS}:" in record.engine, record.engine


@pytest.mark.slow
@pytest.mark.parametrize(
    "law", [law for law in HOSTILE if law not in CALLED], ids=lambda law: law.__name__
)
def test_laws_that_break_the_contract_are_not_compiled(law, monkeypatch):
    check(law, monkeypatch)


@pytest.mark.slow
@pytest.mark.parametrize("law", [Caches, KeepsFirst, InItself], ids=lambda law: law.__name__)
def test_one_run_shows_that_calls_depend_on_each_other(law, monkeypatch):
    """A second run in the register, of this law alone, would show it too late."""
    other = load_scenario("postcapture", ["duration=0.1"])
    (scenario,) = scenarios_of(law, 1, monkeypatch)
    found = simulate_many([scenario, other], engine="compiled")
    assert [record.engine.partition(" ")[0] for record in found] == ["drake", "compiled"]


def check_called(law, monkeypatch):
    """The runs are those of Drake, and name the line that cannot be traced."""
    for record in compared_runs.check(scenarios_of(law, 2, monkeypatch), called=True):
        assert f" {THIS}:" in record.engine, record.engine


@pytest.mark.slow
@pytest.mark.parametrize("law", CALLED, ids=lambda law: law.__name__)
def test_laws_that_only_cannot_be_traced_are_called(law, monkeypatch):
    check_called(law, monkeypatch)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(DRAWS))
def test_drawn_laws_that_break_the_contract_are_not_compiled(seed, monkeypatch):
    """Two faults in one law, of all coordinates or of one."""
    random = np.random.default_rng(seed)
    possible = [law for law in HOSTILE if "force" in vars(law) and law is not Shape]
    faults = random.choice(possible, 2, replace=False)
    only = np.arange(11) == random.integers(11) if random.random() < 0.5 else np.ones(11)

    class Drawn(*faults):
        def force(self, sample):
            made = super().force(sample)
            return Pd.force(self, sample) + only[: made.size] * (made - Pd.force(self, sample))

    do = check_called if set(faults) <= {*CALLED, Solves} else check
    do(dataclasses.dataclass(frozen=True, kw_only=True)(Drawn), monkeypatch)


@pytest.mark.parametrize("field", [[1.0], {"a": 1.0}, {1.0}, object(), len])
def test_fields_of_unknown_kinds_are_refused(field):
    @dataclasses.dataclass(frozen=True, kw_only=True)
    class Law(Pd):
        other: object = None

    with pytest.raises(NotCovered, match="field other"):
        parameters_of(Law(k_p=np.ones(3), k_d=np.ones(3), other=field))
