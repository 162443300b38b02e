"""A scenario that was made from a model file, and what there is to say about it."""

import dataclasses
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ffsm_drake.common.numbers import counted, short
from ffsm_drake.common.steps import step
from ffsm_drake.plugins.design.stability import Margins
from ffsm_drake.plugins.design.verdict import Verdict, verdict
from ffsm_drake.plugins.new.urdf.elements import Joint, listed
from ffsm_drake.plugins.new.urdf.servicer import Servicer
from ffsm_drake.scenario import Scenario, load_scenario


@dataclasses.dataclass(frozen=True, kw_only=True)
class NewScenario:
    """A scenario that was made from a URDF."""

    servicer: Servicer
    scenario_file: Path
    scenario: Scenario
    peak_force: Mapping[str, float]  # by coordinate, of perfect tracking of the motion, N m or N
    margins: Mapping[str, Margins]  # stability margins of the paper's mission, by controller
    side: float | None  # m, of a target that is a cube
    remarks: tuple[str, ...]
    mission: Verdict | None = None  # with ``rehearse``
    # Of a mission not expected to go as planned: the change of options that helps, or all tried.
    remedy: str = ""
    tried: tuple[str, ...] = ()

    def judged(self) -> "NewScenario":
        """Return the same scenario with the verdict on the mission in its file."""
        with step("predicting the mission"):
            mission = verdict(load_scenario(str(self.scenario_file)), advises=False)
        return dataclasses.replace(self, mission=mission)

    @property
    def is_as_planned(self) -> bool:
        """Whether no check speaks against the mission as planned."""
        return self.mission is None or self.mission.is_as_planned

    @property
    def payload_mass(self) -> float:
        """True mass of the target, kg."""
        return self.scenario.payload.truth.mass

    def data(self) -> dict[str, Any]:
        """All findings and choices as plain data in SI units; infinite: no limit."""
        found = self.servicer
        joint_keys = ("name", "kind", "unit", "lower", "upper", "effort", "velocity")
        files = sorted(path for path in self.scenario_file.parent.rglob("*") if path.is_file())
        return {
            "scenario": str(self.scenario_file),
            "files": list(map(str, files)),
            "base": {"link": found.base, "mass": found.base_mass},
            "total_mass": found.total_mass,
            "payload_mass": self.payload_mass,
            "payload_size": self.side,
            "joints": [{key: getattr(joint, key) for key in joint_keys} for joint in found.joints],
            "tip": found.tip.frame,
            "second_tip": None if found.second is None else found.second.frame,
            "other_frames": found.other_frames,
            "tips": [dataclasses.asdict(tip) for tip in (found.tip, *found.other_tips)],
            "duration": self.scenario.reference.duration,
            "peak_force": dict(self.peak_force),
            "margins": {
                name: {"verdict": each.verdict, "stable": each.is_stable}
                for name, each in self.margins.items()
            },
            "remarks": list(self.remarks),
            "remedy": self.remedy,
        }

    def summary(self) -> str:
        """Return the findings as text: base, joints, tip, masses, margins, next commands."""
        found, folder = self.servicer, _relative(self.scenario_file.parent)
        lines = [
            f"base        {found.base}, {short(found.base_mass, 4)} kg of "
            f"{short(found.total_mass, 4)} kg; holds a target of {short(self.payload_mass, 4)} kg"
            + (f", a cube of {self.side:g} m" if self.side else "")
        ]
        for tip in (found.tip, found.second, *found.other_tips):
            if tip is not None:
                length = f"{counted(len(tip.joints), 'joint')}, reach {tip.reach:.3g} m"
                other = f"            or {tip.frame}, {length}: --tip {tip.frame}"
                held = tip in (found.tip, found.second)
                lines.append(f"tip         {tip.frame}, {length}" if held else other)
        told = {tip.frame for tip in (found.second, *found.other_tips) if tip is not None}
        if others := [frame for frame in found.other_frames if frame not in told]:
            lines.append(f"            or {listed(others)}: --tip NAME")
        width = max(28, *(len(joint.name) + 2 for joint in found.joints))
        lines += ["", f"{'joint':<{width}}{'kind':<12}{'limits':>24}{'peak force':>14}"]
        for joint in found.joints:
            unit, peak = "N" if joint.unit == "m" else "N m", self.peak_force[joint.name]
            lines.append(
                f"{joint.name:<{width}}{joint.kind:<12}{limits_text(joint):>24}"
                f"{short(peak):>10} {unit}"
            )
        lines += ["", f"planned motion of {self.scenario.reference.duration:g} s"]
        if self.margins:
            verdicts = (f"{name} {each.verdict}" for name, each in self.margins.items())
            lines[-1] += f"; sampled loop: {', '.join(verdicts)}"
        entries = sorted(path.name for path in self.scenario_file.parent.iterdir())
        scenario = shlex.quote(str(folder / self.scenario_file.name))
        verbs = ["run", "compare", "stability", "design"]
        if found.second is not None:  # with gains of one law
            verbs.remove("compare")
        return "\n".join([
            *lines,
            *(["", *(f"- {remark}" for remark in self.remarks)] if self.remarks else []),
            "",
            f"Written to {folder}: {', '.join(entries)}",
            "Next:",
            *(f"  ffsm {verb} {scenario}" for verb in verbs),
        ])  # fmt: skip


def limits_text(joint: Joint) -> str:
    """Return the range of a joint as text."""
    if not joint.is_limited:
        return "no limits"
    return f"{joint.lower:.4g} to {joint.upper:.4g} {joint.unit}"


def _relative(path: Path) -> Path:
    """Return the path relative to the working directory if it is inside."""
    return path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path
