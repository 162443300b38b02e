"""Laws with the interface of an agent, and one of them: a trained policy from an ONNX file.

``controller: policy:FILE`` names a policy: the network maps observations (1, n; float32) to
actions (1, na) between -1 and 1, described in the file's metadata (``PolicyFile``). A file imports
nothing: the user names a user-supplied law for its actions, ``policy:FILE@LAW``. It
needs ``pip install 'ffsm-drake[policy]'``.
"""

import abc
import dataclasses
import functools
import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from ffsm_drake.common.errors import BlockError, one_line
from ffsm_drake.common.files import check_regular
from ffsm_drake.plugins.task_space.tasks import TaskSpace
from ffsm_drake.runs.tracking import FRAME_COORDINATES, FRAME_GROUPS
from ffsm_drake.scenario import Scenario
from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.systems.controllers import ControlLaw, Sample, State, make_law
from ffsm_drake.systems.frame_path import tracked_rows
from ffsm_drake.systems.registry import block_names
from ffsm_drake.systems.setup import BlockSetup

ACTIONS = ("force", "residual", "setpoint")
FURTHEST = 100.0  # m or rad; observations are bounded, as many learners want it
_MAX_FILE = 2_000_000_000  # bytes; what ONNX can hold
_HELD, _AGE = "action", "action_age"  # memory of a policy whose actions last several samples


def error_names(
    scenario: Scenario, coordinates: Coordinates, *, tracks_frame: bool
) -> list[tuple[str, str]]:
    """Names of the errors observed by an agent, each with its tolerance group."""
    errors = [*zip(coordinates.names, coordinates.group_of, strict=True)]
    if not tracks_frame:
        return errors
    of_frame = [*zip(FRAME_COORDINATES, FRAME_GROUPS, strict=True)]
    return errors + of_frame[tracked_rows(scenario)]


def observation_names(
    scenario: Scenario, coordinates: Coordinates, *, tracks_frame: bool
) -> tuple[str, ...]:
    """Names of what an agent observes."""
    errors = error_names(scenario, coordinates, tracks_frame=tracks_frame)
    return (
        *(f"error.{name}" for name, _ in errors),
        *(f"error_rate.{name}" for name, _ in errors),
        *(f"position.{name}" for name in coordinates.position_names),
        *(f"velocity.{name}" for name in coordinates.names),
    )


def observation(seen: np.ndarray, dtype: Any = np.float32) -> np.ndarray:
    """Observation of an agent (..., n), within its bounds."""
    bounded: np.ndarray = np.clip(seen, -FURTHEST, FURTHEST)
    return bounded.astype(dtype)


@dataclasses.dataclass(frozen=True, kw_only=True)
class ActingLaw(ControlLaw):
    """A law whose force is an action's, or another law's changed by it."""

    kind: str  # one of ACTIONS
    acts: np.ndarray  # (na) indices in v
    scale: np.ndarray  # (na) of the actions, N m and N, or rad and m
    inner: ControlLaw | None  # None: the action alone
    task: TaskSpace | None  # task space of a law that tracks a frame

    @property
    def tracks_frame(self) -> bool:  # type: ignore[override]
        return self.task is not None

    def initial_state(self) -> State:
        return {} if self.inner is None else self.inner.initial_state()

    def held(self) -> Mapping[str, float | None]:
        return {} if self.inner is None else self.inner.held()

    def resume(self, state: State, before: ControlLaw, reference: np.ndarray) -> State:
        if self.inner is None or not isinstance(before, ActingLaw) or before.inner is None:
            return state
        own = {name: state[name] for name in self.inner.initial_state()}
        return {**state, **self.inner.resume(own, before.inner, reference)}

    @abc.abstractmethod
    def action(self, seen: np.ndarray, sample: Sample, state: State) -> tuple[np.ndarray, State]:
        """The action (..., na) for what is seen (..., n), and memory for the next sample."""

    def told(self, error: np.ndarray, force: np.ndarray) -> State:
        """Memory from the errors that are observed at a sample, and from the force."""
        return {}

    def step(self, sample: Sample, state: State) -> tuple[np.ndarray, State]:
        error, rate = sample.e, sample.e_dot
        if self.task is not None:
            point = self.task.at(sample, damping=0.0)
            error = np.concatenate([error, point.e], axis=-1)
            rate = np.concatenate([rate, point.e_dot], axis=-1)
        seen = np.concatenate([error, rate, sample.q, sample.v], axis=-1)
        change, (action, own) = np.zeros_like(sample.v), self.action(seen, sample, state)
        change[..., self.acts] = action * self.scale
        if self.kind == "setpoint":
            sample = sample._replace(e=sample.e + change)
        force = change
        if self.inner is not None:
            others = {name: values for name, values in state.items() if name not in own}
            force, after = self.inner.step(sample, others)
            own = {**own, **after}
            if self.kind == "residual":
                force = force + change
        return force, {**own, **self.told(error, force)}


def inner_law(name: str, setup: BlockSetup) -> ControlLaw:
    """The law of a scenario that actions change. Raises BlockError: it is no law."""
    inner = make_law(setup.mission.flown_by(controller=name), setup.nominal)
    if not isinstance(inner, ControlLaw):
        raise BlockError(f"{name}: must be a control law")
    return inner


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class PolicyFile:
    """A network with the metadata of its file; the factory of its law.

    The metadata are texts: ``observation_names``, ``action_names`` and ``scale`` (of each action)
    as JSON lists, ``action`` (one of ACTIONS), ``law`` (the shipped or installed law changed by
    actions), ``samples_per_step`` (duration of an action). ``MissionEnv.policy_metadata`` returns
    the metadata of an environment.
    """

    path: Path
    session: Any  # onnxruntime.InferenceSession
    observation_names: tuple[str, ...]
    action_names: tuple[str, ...]
    scale: np.ndarray
    action: str
    law: str
    samples_per_step: int

    @classmethod
    def at(cls, path: Path, *, law: str = "") -> "PolicyFile":
        """Load a policy file. Raises BlockError: not a policy, or invalid metadata.

        Args:
          path: the ONNX file.
          law: the law changed by actions, in place of the file's.
        """
        found = _read(path, path.stat().st_mtime_ns)
        if law:
            return dataclasses.replace(found, law=law)
        known = block_names("controller")
        if found.action != "force" and found.law not in known:
            problem = f"law is one of {', '.join(known)}, not {found.law!r:.80}"
            remedy = f"name your own beside the file: policy:{path.name}@module:attribute"
            raise BlockError(f"policy:{path.name}: metadata: {problem}; {remedy}")
        return found

    @property
    def tracks_frame(self) -> bool:
        """Whether the agent observes a frame, and so follows it."""
        return any(name.startswith("error.frame_") for name in self.observation_names)

    def __call__(self, setup: BlockSetup) -> ControlLaw:
        """The law for a scenario. Raises BlockError: it observes, or drives, something else."""
        coordinates, scenario = setup.coordinates, setup.scenario
        seen = observation_names(scenario, coordinates, tracks_frame=self.tracks_frame)
        _check_names("observations", self.observation_names, seen, self.path)
        driven = tuple(coordinates.names[i] for i in coordinates.driven)
        _check_names("actions", self.action_names, driven, self.path)
        return PolicyLaw(
            policy=self,
            kind=self.action,
            acts=coordinates.driven,
            scale=self.scale,
            inner=inner_law(self.law, setup) if self.action != "force" else None,
            task=TaskSpace.from_setup(setup) if self.tracks_frame else None,
        )

    def act(self, seen: np.ndarray) -> np.ndarray:
        """Actions (..., na) for what is seen (..., n), each row by itself."""
        name = self.session.get_inputs()[0].name
        rows = observation(seen.reshape(-1, seen.shape[-1]))
        try:
            found = [self.session.run(None, {name: row[None]})[0] for row in rows]
        except Exception as error:  # many kinds of errors
            problem = f"the network cannot be run: {_why(error)}"
            raise BlockError(f"policy:{self.path.name}: {problem}") from error
        actions = np.clip(np.array(found, dtype=float), -1.0, 1.0)
        if not np.isfinite(actions).all():
            raise BlockError(f"policy:{self.path.name}: an action is not a number")
        return actions.reshape(*seen.shape[:-1], len(self.action_names))


@dataclasses.dataclass(frozen=True, kw_only=True)
class PolicyLaw(ActingLaw):
    """The law of a policy."""

    least_change: ClassVar[float] = 1e-4
    policy: PolicyFile

    def initial_state(self) -> State:
        own: State = {}
        if self.policy.samples_per_step > 1:
            own = {_HELD: np.zeros(self.acts.size), _AGE: np.zeros(1)}
        return {**super().initial_state(), **own}

    def held(self) -> Mapping[str, float | None]:
        # a linearisation needs an action at every sample
        own = {} if self.policy.samples_per_step == 1 else {_AGE: 0.0}
        return {**super().held(), **own}

    def action(self, seen: np.ndarray, sample: Sample, state: State) -> tuple[np.ndarray, State]:
        last = self.policy.samples_per_step
        if last == 1:
            return self.policy.act(seen), {}
        age = np.zeros_like(state[_AGE]) if sample.is_first else state[_AGE]
        due = age < 0.5
        acting = np.where(due, self.policy.act(seen), state[_HELD]) if due.any() else state[_HELD]
        return acting, {_HELD: acting, _AGE: (age + 1.0) % last}


@functools.cache
def _read(path: Path, changed: int) -> PolicyFile:
    try:
        import onnxruntime
    except ImportError as error:
        needs = "needs onnxruntime: pip install 'ffsm-drake[policy]'"
        raise BlockError(f"policy:{path.name} {needs}") from error
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4  # errors are raised
    try:
        check_regular(path, limit=_MAX_FILE)
        session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # many kinds of errors
        problem = f"is no ONNX model that can be run: {_why(error)}"
        raise BlockError(f"policy:{path.name} {problem}") from error
    return _checked(path, session, session.get_modelmeta().custom_metadata_map)


def _checked(path: Path, session: Any, given: Mapping[str, str]) -> PolicyFile:
    """The policy of a network and its metadata. Raises BlockError."""
    try:
        names = [
            tuple(map(str, json.loads(given[f"{of}_names"]))) for of in ("observation", "action")
        ]
        policy = PolicyFile(
            path=path,
            session=session,
            observation_names=names[0],
            action_names=names[1],
            scale=np.array(json.loads(given["scale"]), dtype=float),
            action=given["action"],
            law=given.get("law", ""),
            samples_per_step=int(given.get("samples_per_step", "1")),
        )
    except KeyError as error:
        problem = f"lacks metadata {error}; MissionEnv.policy_metadata() has what to store"
        raise BlockError(f"policy:{path.name} {problem}") from error
    except (ValueError, TypeError) as error:
        raise BlockError(f"policy:{path.name}: metadata: {one_line(error)}") from error
    wanted = [len(each) for each in names]
    right = policy.action in ACTIONS and policy.scale.shape == (wanted[1],)
    if not (right and np.isfinite(policy.scale).all() and policy.samples_per_step >= 1):
        problem = f"action is one of {', '.join(ACTIONS)}, scale a number for each action"
        raise BlockError(f"policy:{path.name}: metadata: {problem}, samples_per_step 1 or more")
    if problem := _problem_of(session, *wanted):
        raise BlockError(f"policy:{path.name}: {problem}")
    return policy


def _problem_of(session: Any, observations: int, actions: int) -> str:
    """The first problem of a network's input and output, for these numbers; empty: there is none.

    Sizes without a number are those of the trial.
    """
    inputs, outputs = session.get_inputs(), session.get_outputs()
    if len(inputs) != 1 or not outputs:
        names = ", ".join(each.name for each in inputs) or "none"
        problem = f"must have one input and an output, not the inputs {names:.80}"
        return f"{problem}; a recurrent network, which needs its state as an input, cannot be used"
    ports = {"input": (inputs[0], observations), "output": (outputs[0], actions)}
    for kind, (port, size) in ports.items():
        if port.type not in ("tensor(float)", *(["tensor(double)"] * (kind == "output"))):
            return f"its {kind} has the type {port.type:.80}; must be tensor(float); export float32"
        shape = tuple(port.shape)
        pairs = zip(shape, (1, size), strict=False)
        if len(shape) != 2 or any(isinstance(own, int) and own != n for own, n in pairs):
            return f"its {kind} has the shape {shape}; must be (1, {size}), as its names are"
    trial = np.zeros((1, observations), np.float32)
    try:
        shape = np.shape(session.run(None, {inputs[0].name: trial})[0])
    except Exception as error:  # many kinds of errors
        return f"the network cannot be run: {_why(error)}"
    wanted = (1, actions)
    return "" if shape == wanted else f"gives actions of the shape {shape}, not {wanted}"


def _why(error: Exception) -> str:
    """The first words of an error of ONNX Runtime."""
    return re.sub(r"^\[ONNXRuntimeError\] : \d+ : \w+ : ", "", one_line(error))[:300]


def _check_names(what: str, own: Sequence[str], there: Sequence[str], path: Path) -> None:
    """Raise BlockError unless names are those of the scenario, in its order."""
    if tuple(own) == tuple(there):
        return
    pairs = enumerate(zip(own, there, strict=False))
    at = next((i for i, (a, b) in pairs if a != b), min(len(own), len(there)))
    first, second = (f"'{each[at]}'" if at < len(each) else "nothing" for each in (own, there))
    problem = f"number {at + 1} of its {what} is {first}, of this scenario's {second}"
    raise BlockError(f"policy:{path.name} was trained on another spacecraft or task: {problem}")
