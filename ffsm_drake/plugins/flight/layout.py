"""The structs of an exported law, and the places of a traced function's arrays in them."""

import re
from collections.abc import Callable, Collection, Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np

from ffsm_drake.plugins.flight.functions import Precision
from ffsm_drake.plugins.flight.traced import FlightLaw
from ffsm_drake.plugins.tape.numbers import NotTraceable
from ffsm_drake.scenario import Scenario
from ffsm_drake.systems.frame_path import FRAME_SIZE

WITHOUT = "_without_target"  # the end of the names of what belongs to the law before a grasp
HELD_FOR = 0.1  # s, that the last force is held
LARGEST = 1e9  # of an input, rad, m, N m, N
MOST_MEMORY = 4096  # numbers; law_step has the memory on its stack twice
NORM = 0.1  # tolerance of a quaternion's squared norm, which integrators let drift
# Whole numbers at the end of each struct, and what they are.
WHOLES: Mapping[str, Mapping[str, str]] = {
    "in": {
        "sample": "number of the control sample, from 0",
        "is_first": "1: there is no sample before, or velocities jumped since",
        "holds": "1: the target is held; read only if LAW_HAS_CAPTURE",
    },
    "gains": {},
    "state": {
        "has_started": "1: there was a good sample",
        "good": "good samples in a row, at most LAW_SETTLED",
        "holds": "1: the last good sample had the target",
        "bad": "bad samples in a row",
    },
    "out": {
        "status": "law_status",
        "causes": "bits LAW_BAD_...: why the sample was not good",
        "warnings": "bits LAW_BEYOND_..., LAW_FORCE_LIMITED",
    },
}
_WORDS = re.compile(
    "auto|break|case|char|const|continue|default|do|double|else|enum|extern|float|for|goto|if|"
    "inline|int|long|register|restrict|return|short|signed|sizeof|static|struct|switch|typedef|"
    "union|unsigned|void|volatile|while|bool|true|false"
)
# Fields of ``law_in`` with an input of a law: of its positions, and of its velocities.
_FIELDS = {
    "estimated_state": ("q", "v"),
    "desired_state": ("q_d", "v_d"),
    "desired_acceleration": ("a_d", ""),
    "measurement_is_new": ("is_new", ""),
}


class Field(NamedTuple):
    """Numbers of a struct."""

    name: str
    size: int
    about: str


class Layout:
    """The structs of a law, which has one nominal model, or one before and one after a grasp."""

    def __init__(
        self,
        scenario: Scenario,
        laws: Mapping[bool, FlightLaw],
        precision: Precision,
        reads: frozenset[str],
    ) -> None:
        """Args:
        scenario: the scenario.
        laws: by whether they hold the target.
        precision: of the numbers.
        reads: inputs that the laws read.
        """
        self.scenario, self.laws, self.precision, self.reads = scenario, laws, precision, reads
        self.law = laws[True]
        coordinates = self.law.coordinates
        self.nq, self.nv = coordinates.num_positions, coordinates.num_velocities
        # the field of each piece of memory; one that both laws begin with alike is one
        self._memory = {holds: self._memory_fields(holds=holds) for holds in laws}
        self.fields = {"in": self._inputs(), "gains": self._gains(), "state": self._state()}
        self.fields["out"] = [
            Field("force", self.nv, "hold it until the next sample"),
            Field("commanded", self.nv, "before limits and quantisation of the force"),
        ]

    @property
    def captures(self) -> bool:
        """Whether there is a law before a grasp too."""
        return len(self.laws) > 1

    @property
    def sizes(self) -> dict[str, int]:
        """Bytes of each struct."""
        real, found = 4 if self.precision.single else 8, dict[str, int]()
        for name, fields in self.fields.items():
            size = real * sum(each.size for each in fields) + 4 * len(WHOLES[name])
            found[f"law_{name}"] = -(-max(size, 1) // real) * real
        return found

    def _memory_fields(self, *, holds: bool) -> dict[str, str]:
        """The fields of a law's memory by its names."""
        own, other = (self.laws[which].memory for which in (holds, True))
        fields = dict(zip(own, identifiers(own, taken=WHOLES["state"]), strict=True))
        unlike = (name for name in own if name in other and np.any(own[name] != other[name]))
        return fields | {name: fields[name] + WITHOUT for name in unlike}

    def _inputs(self) -> list[Field]:
        nq, nv = self.nq, self.nv
        wrench = self.law.inputs.get("measured_wrench", 0)
        optional = {
            "measurement_is_new": Field("is_new", nq + nv, "[q; v] 1: measured now, 0: repeated"),
            "desired_frame": Field(
                "desired_frame", FRAME_SIZE, "[quaternion; p; w; v; alpha; a] of the frame, world"
            ),
            "measured_wrench": Field("measured_wrench", wrench, "at the contacts"),
        }
        return [
            Field("q", nq, "measured"),
            Field("v", nv, "measured"),
            Field("q_d", nq, "reference"),
            Field("v_d", nv, "reference"),
            Field("a_d", nv, "reference: time derivative of v_d"),
            Field("applied_force", nv, "over the last period; zero at the first sample"),
            *(field for name, field in optional.items() if name in self.reads),
        ]

    def _gains(self) -> list[Field]:
        gains = self.law.gains
        return [
            Field(field, values.size, f"{declared.unit or '1'}: {declared.meaning}")
            for field, (declared, values) in zip(identifiers(gains), gains.values(), strict=True)
        ]

    def _state(self) -> list[Field]:
        found = dict[str, Field]()
        for holds, law in self.laws.items():
            for name, place in self._memory[holds].items():
                found[place] = Field(place, law.memory[name].size, f"'{name}' of the law")
        kept = [field for field in found.values() if field.size]
        if sum(field.size for field in kept) > MOST_MEMORY:
            raise NotTraceable(f"a memory of more than {MOST_MEMORY} numbers, too many for a stack")
        return [*kept, Field("last_force", self.nv, "of the last good sample")]

    def memory_at(self, entry: int, *, holds: bool) -> str:
        """The place of an entry of a law's memory in ``law_state``."""
        sizes = {name: values.size for name, values in self.laws[holds].memory.items()}
        name, at = located(sizes, entry)
        return f"{self._memory[holds][name]}[{at}]"

    def source(self, *, holds: bool) -> Callable[[str, int], str]:
        """Where a function of a law reads an entry of an array."""

        def place(array: str, entry: int) -> str:
            if array == "planned":
                return f"planned[{entry}]"
            if array == "memory":
                return f"before->{self.memory_at(entry, holds=holds)}"
            if array == "gains":
                sizes = {each.name: each.size for each in self.fields["gains"]}
                return "gains->{}[{}]".format(*located(sizes, entry))
            position, velocity = _FIELDS.get(array, (array, ""))
            if velocity and entry >= self.nq:
                return f"in->{velocity}[{entry - self.nq}]"
            return f"in->{position}[{entry}]"

        return place

    def target(self, *, holds: bool) -> Callable[[str, int], str]:
        """Where it writes one."""

        def place(array: str, entry: int) -> str:
            if array == "after":
                return f"next->{self.memory_at(entry, holds=holds)}"
            return f"out->{array}[{entry}]"

        return place


def located(sizes: Mapping[str, int], entry: int) -> tuple[str, int]:
    """The array that has an entry, of some in a row, and its place there."""
    for name, size in sizes.items():
        if entry < size:
            return name, entry
        entry -= size
    raise IndexError(entry)


def identifiers(names: Iterable[str], taken: Collection[str] = ()) -> list[str]:
    """Names that C takes, each another one."""
    found = list[str]()
    for name in names:
        own = re.sub(r"\W", "_", name, flags=re.ASCII)
        own = f"_{own}" if own[:1].isdigit() else own
        while _WORDS.fullmatch(own) or own in (*taken, *found, "last_force"):
            own += "_"
        found.append(own)
    return found


def numbers(values: Any, precision: Precision) -> str:
    """Numbers of C, with commas."""
    return ", ".join(map(precision.number, np.ravel(values).tolist()))
