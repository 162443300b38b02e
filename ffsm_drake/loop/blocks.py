"""The blocks of the closed loop, their ports and systems.

A block is a named place in the diagram. The scenario's own section fills it (``sensing``,
``actuation``, ...), unless ``blocks`` in the scenario, or a factory given in Python, puts another
system there.

Any block may have methods ``set_initial_state(context, state)``, called before a run with the
block's context and the plant's [q; v], and ``set_payload(context, properties)``, called with the
true payload's ``MassProperties`` before that and whenever they change.
"""

import dataclasses
import hashlib
from collections.abc import Collection, Iterable, Mapping
from typing import Any

from pydrake.systems.framework import System

from ffsm_drake.common.errors import BlockError, ScenarioError, choices
from ffsm_drake.common.guard import calling
from ffsm_drake.common.settings import require_valid
from ffsm_drake.mission import Mission
from ffsm_drake.scenario import Block, Scenario, build_settings, kind_of
from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.spacecraft.plant import resolve_package
from ffsm_drake.systems.continuous import Continuous, InstantSystem
from ffsm_drake.systems.controllers import make_controller
from ffsm_drake.systems.controllers.controller import LAW_SIGNALS
from ffsm_drake.systems.faults import settle_faults
from ffsm_drake.systems.frame_path import FRAME_SIZE
from ffsm_drake.systems.parts.part import Part
from ffsm_drake.systems.parts.placed import PlacedPart, place_part
from ffsm_drake.systems.registry import (
    Factory,
    base_actuators,
    call_factory,
    find_factory,
    module_file,
    section_parts,
)
from ffsm_drake.systems.sampled import Sampled, SampledSystem
from ffsm_drake.systems.setup import BlockSetup, inputs_of, outputs_of

STATE, VELOCITY = "nq + nv", "nv"  # sizes of ports
FRAME, NUMBER, UNITS = str(FRAME_SIZE), "1", "units"
# Wrenches on the target, of the contacts that close loops (``contacts``): 6 for each.
WRENCH, WRENCHES = "measured_wrench", "6 contacts"
# Force on jammed joints, from the solve that gives the force of these contacts.
JAM = "jam_force"
# Outputs of actuators that act on the plant in addition to the applied force.
ADDED_FORCES = ("gyroscopic_force", "friction_force")
# The output port with which a block requests the supervisor to act, by a value above 0.5.
ABORT = "abort_request"
TOLD = "told_force"  # force that the actuators report (faults not included)
# Outputs of actuators for forces that follow from them: the mean force of each of n thrusters; the
# angular momentum of wheels (world axes). These forces are held over a sample and recorded by their
# own parts.
READ_BY_FORCES = {"thruster_force": "n", "stored_momentum": "3"}
# Outputs of actuators that fault detection reads, along v and by unit; and what it tells them.
REPORTED_FORCES = (TOLD, "gyroscopic_force")
REPORTED_UNITS = ("told_units", "wheel_momentum")
ISOLATED = "isolated"
# nh: number of hidden coordinates (``model.flexible``)
HIDDEN_STATE, HIDDEN, WHOLE_VELOCITY = "2 nh", "nh", "nv + nh"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Ports:
    """The ports of a block: name -> size."""

    inputs: Mapping[str, str] = dataclasses.field(default_factory=dict)
    outputs: Mapping[str, str]
    optional_inputs: Mapping[str, str] = dataclasses.field(default_factory=dict)
    optional_outputs: Mapping[str, str] = dataclasses.field(default_factory=dict)
    held: bool = False  # no output may depend directly on an input


BLOCKS: dict[str, Ports] = {
    "reference": Ports(
        outputs={"desired_state": STATE, "desired_acceleration": VELOCITY},
        # Motion of the prescribed frame F: [quaternion of R_WF; p_WF; w_WF; v_WF; alpha_WF; a_WF].
        optional_outputs={"desired_frame": FRAME},
    ),
    "sensing": Ports(
        # ``state`` is the output of the stage before, of the first one the plant's state.
        inputs={"state": STATE},
        optional_inputs={
            "true_state": STATE,
            "measurement_is_new": STATE,
            **dict.fromkeys(REPORTED_FORCES, VELOCITY),
            **dict.fromkeys(REPORTED_UNITS, UNITS),
            WRENCH: WRENCHES,
        },
        outputs={"estimated_state": STATE},
        # 1: this control sample has a new measurement, 0: it repeats an earlier one. Without
        # this port all are new.
        optional_outputs={"measurement_is_new": STATE, ISOLATED: UNITS},
    ),
    "controller": Ports(
        inputs={"estimated_state": STATE, "desired_state": STATE, "desired_acceleration": VELOCITY},
        optional_inputs={
            "applied_force": VELOCITY,
            "measurement_is_new": STATE,
            "desired_frame": FRAME,
            WRENCH: WRENCHES,
            "restart": NUMBER,  # 1: this sample is a first one, regardless of earlier samples
        },
        outputs={"generalized_force": VELOCITY},
        optional_outputs={
            each.name: VELOCITY if each.dimension else NUMBER for each in LAW_SIGNALS
        },
        held=True,
    ),
    # Between the reference and the controller, and between that and the actuators.
    "supervisor": Ports(
        inputs={
            "estimated_state": STATE,
            "desired_state": STATE,
            "desired_acceleration": VELOCITY,
            "generalized_force": VELOCITY,
        },
        optional_inputs={ABORT: NUMBER, "desired_frame": FRAME},
        outputs={
            "desired_state": STATE,
            "desired_acceleration": VELOCITY,
            "generalized_force": VELOCITY,
        },
        optional_outputs={"restart": NUMBER, "desired_frame": FRAME},
    ),
    "actuation": Ports(
        inputs={"commanded_force": VELOCITY},
        optional_inputs={"state": STATE, ISOLATED: UNITS},
        outputs={"applied_force": VELOCITY},
        # Forces on the plant in addition to the applied force, not held over a sample.
        optional_outputs={**dict.fromkeys(ADDED_FORCES, VELOCITY), TOLD: VELOCITY},
    ),
    "forces": Ports(
        outputs={"generalized_force": VELOCITY},
        # ``other_force``: the sum of all forces but those that read it, along the plant's own v
        optional_inputs={
            "state": STATE,
            "hidden_state": HIDDEN_STATE,
            "other_force": WHOLE_VELOCITY,
            JAM: VELOCITY,
            **READ_BY_FORCES,
        },
        # The force after the update of a control sample: the record would see the one before it.
        # The force on hidden coordinates, after the update of a control sample.
        optional_outputs={
            "next_generalized_force": VELOCITY,
            WRENCH: WRENCHES,
            "hidden_force": HIDDEN,
            "next_hidden_force": HIDDEN,
        },
    ),
}
DISTURBANCE, GRIPPER = "forces.disturbance", "forces.gripper"
# Blocks that may occur several times.
_SEVERAL = ("sensing.<name>", "forces.<name>")
# Blocks that may be ``Sampled``; the forces are held from a sample to the next.
_SAMPLED = ("sensing", "reference", "forces")
# Names of systems that are part of every loop.
_TAKEN = (
    *("plant", "measurement", "states", "reference", "sensing", "controller", "actuation"),
    "supervisor",
)


def make_blocks(
    mission: Mission, nominal: PlantModel, factories: Mapping[str, Factory] | None = None
) -> tuple[dict[str, System], dict[str, PlacedPart]]:
    """All blocks by name, checked, and the parts among them; no ``actuation`` if it is ideal.

    Args:
      mission: its scenario has the systems of the blocks.
      nominal: the plant with the nominal payload; the controller's own.
      factories: block -> factory in place of the scenario's choice; "forces.<name>" for a force.

    Raises:
      ScenarioError: a value is given for an unknown coordinate; an unknown block or name.
      BlockError: a user-supplied block cannot be loaded, built or wired.
    """
    given = factories or {}
    _check_names(given)
    scenario = settle_faults(mission.scenario, mission.craft.coordinates)
    mission = mission.of(scenario)
    choices = scenario.blocks.choices()
    own = section_parts(scenario, given, grip=nominal.grip)  # parts of its own sections
    plain = BlockSetup(name="", mission=mission, nominal=nominal, settings={})
    blocks, placed, others = dict[str, System](), dict[str, PlacedPart](), dict[str, PlacedPart]()
    for name in _in_order((*own, *choices, *given)):
        choice = choices.get(name, Block())
        setup = dataclasses.replace(plain, name=name.rpartition(".")[2], settings=choice.settings)
        made, fill = _made(name, own.get(name), setup, given.get(name), choice.system)
        if made is not None:
            blocks[name] = made
        if isinstance(fill, Part) and name not in own:
            others[name] = place_part(fill, setup, made, name=name, block=name)
    for name, part in own.items():
        block = name if name in blocks else kind_of(name)
        setup = dataclasses.replace(plain, name=name)
        found = place_part(part, setup, blocks.get(block), name=name, block=block)
        if found.signals:
            placed[name] = found
    return blocks, placed | others


def _made(
    name: str, own: Part | None, setup: BlockSetup, given: Any, system: str
) -> tuple[Any, Any]:
    """Return the system of a block, checked, and what fills the block.

    Args: the block; the part of the scenario's section; the setup; a factory in place of the
    scenario's choice; that choice. There is no system of ideal actuators.
    """
    scenario, kind = setup.scenario, kind_of(name)
    if name == "controller":
        place = f"controller '{getattr(given, '__name__', scenario.controller)}'"
        made: Any = make_controller(setup.mission, setup.nominal, given)
        fill: Any = getattr(made, "part", None)  # of a system of its own
        check_ports(made, kind, setup.coordinates, place=place)
        return made, fill
    place = f"blocks.{name} '{getattr(given, '__name__', system)}'"
    fill = own or factory_of(name, scenario, given)
    made = as_system(call_factory(fill, setup, place=place), setup, kind=kind, place=place)
    if made is not None or own is None:
        check_ports(made, kind, setup.coordinates, place=place)
        made.set_name(setup.name if setup.name not in _TAKEN else name.replace(".", "_"))
    return made, fill


def as_system(made: Any, setup: BlockSetup, *, kind: str, place: str) -> Any:
    """Return the system around a block as functions; any other one unchanged."""
    if isinstance(made, Continuous) and kind in ("reference", "forces"):
        return InstantSystem(made, name=setup.name)
    if not isinstance(made, Sampled):
        return made
    if kind not in _SAMPLED:
        kinds = ", ".join(_SAMPLED)
        raise BlockError(f"{place}: a Sampled block is one of {kinds}; write a Drake system")
    return SampledSystem(
        made,
        name=setup.name,
        sample_time=setup.sample_time,
        usual=usual_sizes(kind, setup.coordinates),
        place=place,
        held=kind == "forces",
    )


def _check_names(given: Iterable[str]) -> None:
    """Raise ScenarioError for a name that is no block's."""
    for name in given:
        valid = [*(block for block in BLOCKS if block != "forces"), *_SEVERAL]
        several = f"{kind_of(name)}.<name>" in _SEVERAL and name.partition(".")[2].isidentifier()
        if not several and (name not in valid or name in _SEVERAL):
            raise ScenarioError(
                f"blocks.{name}",
                f"is not a block; choose {choices(name, valid)}",
            )


def _in_order(names: Collection[str]) -> tuple[str, ...]:
    """Return the blocks of a loop, with the stages and forces among some names."""
    stages, forces = (
        dict.fromkeys(name for name in names if name.startswith(f"{kind}."))
        for kind in ("sensing", "forces")
    )
    supervisor, actuation = (
        (name,) if name in names else () for name in ("supervisor", "actuation")
    )
    return ("reference", "sensing", *stages, "controller", *supervisor, *actuation, *forces)


def is_rehearsed(scenario: Scenario) -> bool:
    """Whether a prediction tries the loop with the limits of the scenario's own parts too."""
    return bool(base_actuators(scenario))


def factory_of(name: str, scenario: Scenario, given: Any = None) -> Factory:
    """Return the factory of any block except the controller: a part with its settings, or another
    factory.

    Args:
      name: block name.
      scenario: names the factory, or has a section for the block.
      given: a factory or part that replaces the scenario's choice.

    Raises:
      ScenarioError: an unknown name; a setting is unknown, or its value is not allowed.
      BlockError: the block's system cannot be loaded.
    """
    choice, key = scenario.blocks.choices().get(name), f"blocks.{name}"
    if given is None and choice is None:
        return section_parts(scenario)[name]
    if given is None and choice is not None:
        path = scenario.python_path
        given = find_factory(kind_of(name), choice.system, key=key, python_path=path)
    kind = given if isinstance(given, type) else type(given)
    if not issubclass(kind, Part):
        return given

    def valid() -> Part:
        part: Part = given
        if given is kind:
            settings = {} if choice is None else choice.settings
            part = build_settings(kind, settings, f"{key}.settings")
        require_valid(part, f"{key}.settings", scenario)
        return part

    return calling(f"{key} '{kind.__name__}'", valid, did="cannot be built")


def parts_of(scenario: Scenario, given: Mapping[str, Any] | None = None) -> dict[str, Part]:
    """Return the parts in a scenario's blocks that replace its own sections, by block. Arguments
    and errors: see ``factory_of``.
    """
    given = given or {}
    found = {
        name: factory_of(name, scenario, given.get(name))
        for name in dict.fromkeys((*scenario.blocks.choices(), *given))
        if name != "controller"
    }
    return {name: part for name, part in found.items() if isinstance(part, Part)}


def block_sources(scenario: Scenario) -> dict[str, dict[str, str]]:
    """Origin of each block: ``system``, with ``file`` and ``sha256`` if it comes from a file."""
    forces = [name for name in section_parts(scenario) if kind_of(name) == "forces"]
    sections = ("reference", "sensing", "actuation", *forces)
    names = {name: f"scenario: {name.rpartition('.')[2]}" for name in sections}
    names |= {"controller": scenario.controller}
    names |= {name: choice.system for name, choice in scenario.blocks.choices().items()}
    sources = {}
    for name, system in names.items():
        sources[name], file = {"system": system}, module_file(system)
        if system == "scenario: reference" and scenario.reference.kind == "optimal":
            file = resolve_package(scenario.reference.plan or "")
        if file is not None:
            sources[name] |= {
                "file": str(file),
                "sha256": hashlib.sha256(file.read_bytes()).hexdigest(),
            }
    return sources


def _sizes(coordinates: Coordinates) -> dict[str, int]:
    """Numbers in the ports of one spacecraft, by their size in words, where it is known."""
    nv = len(coordinates.names)
    stored = READ_BY_FORCES["stored_momentum"]
    return {STATE: 2 * nv + 1, VELOCITY: nv, FRAME: FRAME_SIZE, NUMBER: 1, stored: 3}


def usual_sizes(block: str, coordinates: Coordinates) -> dict[str, int]:
    """Return the numbers in the ports of a block of BLOCKS, by name, where they are known."""
    ports, sizes = BLOCKS[kind_of(block)], _sizes(coordinates)
    words = {
        **ports.inputs, **ports.outputs, **ports.optional_inputs, **ports.optional_outputs,
    }  # fmt: skip
    return {name: sizes[size] for name, size in words.items() if size in sizes}


def check_ports(system: Any, block: str, coordinates: Coordinates, *, place: str) -> None:
    """Raise BlockError for a system without a block's ports, or with other sizes.

    Args:
      system: the system of the block.
      block: a key of BLOCKS.
      coordinates: the spacecraft's; they determine the sizes.
      place: names the block in the error.
    """
    ports = BLOCKS[block]
    if not isinstance(system, System):
        wanted = "a control law or a Drake system" if block == "controller" else "a Drake system"
        raise BlockError(f"{place} must be {wanted}, not {type(system).__name__}")
    try:
        system.get_name()
    except TypeError:
        cause = "TypeError: its __init__ must call super().__init__() first"
        raise BlockError(f"{place} cannot be built: {cause}") from None
    size = _sizes(coordinates)
    known = {**ports.inputs, **ports.optional_inputs}
    inputs, outputs = inputs_of(system), outputs_of(system)
    for name in inputs:
        if name not in known:  # unconnected
            raise BlockError(f"{place}: unknown input port '{name}'; known: {choices(name, known)}")
    for kind, required, words, found in (
        ("input", ports.inputs, known, inputs),
        ("output", ports.outputs, {**ports.outputs, **ports.optional_outputs}, outputs),
    ):
        for name, word in words.items():
            if name not in found:
                if name in required:
                    raise BlockError(f"{place}: needs an {kind} port '{name}' of size {size[word]}")
                continue
            port = found[name]
            if port.size() != size.get(word, port.size()):
                raise BlockError(
                    f"{place}: {kind} port '{name}' must have size {size[word]}, not {port.size()}"
                )
            if kind == "output" and ports.held and system.HasDirectFeedthrough(port.get_index()):
                raise BlockError(
                    f"{place}: output port '{name}' must not depend directly on an input; use "
                    "DeclareStateOutputPort, or prerequisites {self.all_state_ticket()}"
                )
